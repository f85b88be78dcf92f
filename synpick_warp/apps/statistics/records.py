"""Schemas of what statistics read: episodes, bins, attempts, light. Other keys are passed over."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, UnsetType

from synpick_warp.dataset.annotations import Index, Length, LenientCameraEntry

MAX_NAME = 256
"""Longest name of a mode, an ending, an outcome, a split or a light map."""
Name = Annotated[str, Meta(max_length=MAX_NAME)]


LookFacts = dict[Name, Length | list[Length] | Name]
"""Parameters of a body that an episode has drawn."""
Looks = dict[Name, Length | LookFacts | list[LookFacts]]
"""An episode's looks, as its row has them."""


class BinFacts(msgspec.Struct):
    """Bin of an episode: name, position [m] and yaw [rad] in the world."""

    name: Name
    position: tuple[Length, Length, Length]
    yaw: Length


class EpisodeFacts(msgspec.Struct):
    """Manifest row of an episode: mode, frames, ending, object counts, looks, and the bin if it is told."""

    mode: Name
    frames: Index
    ending: Name
    objects: Index = 0
    picked: Index = 0
    lost: Annotated[int, Meta(ge=-(2**31), lt=2**31)] = 0
    looks: Looks = {}
    """Empty: they are not randomized."""
    bin: BinFacts | None = None


class AttemptFacts(msgspec.Struct):
    """Attempt to pick, as the manifest records it: outcome, whether the seal was good, engaged instances, seal force by tick [N]."""

    outcome: Name
    good_seal: bool = False
    engaged: Annotated[list[Index], Meta(max_length=255)] = []
    peak_force: Annotated[list[Annotated[float, Meta(ge=0.0, le=1e9)]], Meta(max_length=100_000)] = []
    """Largest force on any seal in each tick of the lift [N]."""
    break_force: Annotated[float, Meta(ge=0.0, le=1e9)] | None = None
    """Least break force of its seals [N]; None: that of the settings."""


class Light(msgspec.Struct, gc=False):
    """An episode's environment map, its yaw [rad] and exposure compensation [EV]."""

    map: Name
    yaw: Length
    exposure: Length


class LitCameraEntry(LenientCameraEntry, gc=False):
    """Schema of a view's entry in scene_camera.json with its light, which only data sets of this program have."""

    light: Light | UnsetType = UNSET
