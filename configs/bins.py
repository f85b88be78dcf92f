"""Settings of the bins that stand under the cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from synpick_warp.configs.fields import setting

TOTE, OWN, NONE, PALLET = "tote", "own", "none", "pallet"
KINDS = (TOTE, OWN, NONE, PALLET)
"""What stands under the cameras."""


@dataclass(frozen=True)
class Tote:
    """The tote (an open box). Its frame is the world frame: origin at the centre of the inner floor, z up. Sizes of the released mesh."""

    outer_size: tuple[float, float, float] = setting((0.615, 0.373, 0.200), "m", "Outer length, width and height.", above=0.0, high=10.0)
    floor_size: tuple[float, float] = setting((0.513, 0.319), "m", "Length and width of the inner floor.", above=0.0, high=10.0)
    rim_size: tuple[float, float] = setting((0.545, 0.352), "m", "Length and width of the opening at the rim.", above=0.0, high=10.0)
    wall: float = setting(0.0045, "m", "Thickness of walls and floor.", above=0.0, high=1.0)
    color: tuple[float, float, float] = setting((0.65, 0.05, 0.04), "sRGB", "Base colour.", low=0.0, high=1.0)
    metallic: float = setting(0.0, "", "Metallic factor.", low=0.0, high=1.0)
    roughness: float = setting(0.5, "", "Roughness.", low=0.0, high=1.0)


@dataclass(frozen=True)
class BinRow(Tote):
    """A bin of bins.kind = "own", an open box as the tote. An episode draws one of the bins by their weights."""

    REQUIRED: ClassVar = ("name",)
    name: str = setting("", "", "Name, of at most 32 lower-case letters, digits and underscores; no two bins have the same.")
    weight: float = setting(1.0, "", "Weight with which an episode draws it.", low=0.0, high=1e6)
    compartments: tuple[int, int] = setting((1, 1), "", "Columns (along x) and rows of compartments of equal floors.", low=1, high=6)
    divider_height: float = setting(0.1, "m", "Height of the dividers between compartments.", above=0.0, high=10.0)


@dataclass(frozen=True)
class Bins:
    """What stands under the cameras: the tote, or without walls a table alone or a pallet, whose frame has its origin on top."""

    kind: str = setting(
        TOTE,
        "",
        "What objects are dropped into or onto: tote ([tote]), own (a bin of [[bin]], drawn in each episode), none (the table), pallet.",
        choices=KINDS,
    )
    shift: tuple[float, float] = setting(
        (0.0, 0.0), "m", "Half widths of the offset in x and y that each episode draws for its bin.", low=0.0, high=1.0
    )
    yaw: float = setting(0.0, "°", "Half width of the rotation about z that each episode draws for its bin.", low=0.0, high=180.0)
    area: tuple[float, float] = setting(
        (0.5, 0.35), "m", "Length and width over which objects are dropped, without walls.", above=0.0, high=10.0
    )
    margin: float = setting(0.15, "m", "Without walls, an object that is farther outside of the area has left.", low=0.0, high=5.0)
    pallet_size: tuple[float, float, float] = setting(
        (0.6, 0.4, 0.144), "m", "Length, width and height of the pallet; half a EUR pallet by default.", above=0.0, high=10.0
    )
