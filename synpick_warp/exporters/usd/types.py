"""Plain descriptions that the bake sends to the writer processes of USD episodes. Imports neither pxr nor OpenCV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from synpick_warp.codes import Ending, LookPart
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.scenes.types import FIRST_DISTRACTOR, Camera, Material
from synpick_warp.views.frames import EpisodeEnd


@dataclass(frozen=True)
class StageLight:
    """Environment map as a dome light, and its sun as a distant light: azimuth and polar angle of the sun in the map's frame [°],
    irradiance (None: no sun), angular diameter [°].
    """

    name: str
    file: str
    """EXR file, relative to the asset library."""
    intensity: float
    """Factor from the map's radiance to display range."""
    sun_azimuth: float
    """Direction to the sun in the map's frame, counter-clockwise about +z from +x [°]."""
    sun_polar: float
    """Angle between +z and the direction to the sun [°]."""
    sun_irradiance: tuple[float, float, float] | None
    """Irradiance of a surface that faces the sun, linear RGB, in the map's units; None: no distant light."""
    sun_angle: float
    """Angular diameter of the sun [°]."""


TEXTURES = "textures"
"""Folder of textures in the asset library."""


FLOOR = Material((1.0, 1.0, 1.0), None, 0.0, 1.0)
"""Material of the floor before an episode draws its texture."""


@dataclass(frozen=True)
class AssetSurface:
    """Material of an asset, without the pixels of its texture."""

    material: Material
    texture: str | None
    """File of its texture, relative to the asset library; None: it has none."""

    @staticmethod
    def of(name: str, material: Material) -> AssetSurface:
        """That of the asset of this name."""
        return AssetSurface(replace(material, texture=None), None if material.texture is None else texture_file(name))


def texture_file(name: str) -> str:
    """File of a texture, relative to the asset library: that of the asset of this name, or one of those that episodes draw from."""
    return f"{TEXTURES}/{name}.png"


def drawn_texture(part: LookPart, index: int) -> str:
    """Name of a texture that episodes draw for the bin, the table or the background."""
    return f"{part.name.lower()}_{index:03d}"


@dataclass(frozen=True)
class UsdSettings:
    """Settings common to all episodes: tick rate [1/s], gravity [m/s²], bins, cameras, lights, object names by obj_id."""

    tick_rate: float
    """Frames per second of simulated time [1/s]."""
    gravity: float
    """[m/s²]"""
    bins: tuple[str | None, ...]
    """Asset of each bin; None: there is nothing but the table."""
    cameras: tuple[Camera, ...]
    lights: tuple[StageLight, ...]
    names: dict[int, str]
    """obj_id -> name of the object."""
    surfaces: dict[str, AssetSurface]
    """Materials by asset, of those that looks are drawn for; empty: looks are not randomized."""


@dataclass(frozen=True)
class EpisodeMetadata:
    """Properties of an episode's root prim: episode, discarded arrangements before, frames, ending, split (empty: none)."""

    episode: int
    arrangement: int
    """Number of arrangements that were discarded before this one."""
    frames: int
    ending: str
    split: str = ""
    """Name of the episode's split; empty: the data set has none."""
    bin: str = ""
    """Name of the bin; empty: a tote that is always in its place."""
    looks: Mapping[str, Any] = field(default_factory=dict)
    """Record of the episode's looks; empty: they are not randomized."""
    cameras: Mapping[str, Any] = field(default_factory=dict)
    """Matrix and pose of the cameras that the episode draws, by name."""

    @staticmethod
    def from_end(end: EpisodeEnd) -> EpisodeMetadata:
        """Take the metadata from the episode's end."""
        row = end.row or {}
        ending, bin = Ending(end.ending).name.lower(), (row.get("bin") or {}).get("name", "")
        drawn = {name: row.get(name) or {} for name in ("looks", "cameras")}
        return EpisodeMetadata(end.episode, end.arrangement, end.frames, ending, row.get("split", ""), bin, **drawn)


def bin_asset(sizes: BinSizes) -> str:
    """Name of a bin's asset."""
    return sizes.name if sizes.noun == sizes.name else f"bin_{sizes.name}"


def object_asset(obj_id: int) -> str:
    """Name of an object's asset: stem of its file, and name of its root prim. Distractors have obj_ids from FIRST_DISTRACTOR downwards."""
    return f"obj_{obj_id:06d}" if obj_id >= 0 else f"distractor_{FIRST_DISTRACTOR - obj_id:06d}"
