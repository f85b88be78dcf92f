"""Extents of the bins that stand under the cameras, as the settings give them; a table and a pallet are bins without walls."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from synpick_warp.configs.bins import NONE, PALLET, TOTE, Tote
from synpick_warp.configs.schema import Config

Sides = tuple[float, float]
"""Length (along x) and width (along y) [m]."""
Point = tuple[float, float, float]


@dataclass(frozen=True)
class BinSizes:
    """Extents of a bin [m] in its own frame: origin at the centre of the inner floor, z up."""

    name: str
    noun: str
    """What it is, in sentences: tote, bin, pallet or table."""
    shell: Tote | None
    """Sizes and material of its walls; None: it has none."""
    outer: Sides
    floor: Sides
    """Inner floor."""
    opening: Sides
    """At the rim; without walls, the area over which objects are dropped."""
    height: float
    """Height of the rim."""
    base: float
    """z of its underside."""
    margin: float = 0.0
    """Distance from the opening beyond which an object has left it."""
    weight: float = 1.0
    """Weight with which an episode draws it."""

    @classmethod
    def of_tote(cls, tote: Tote) -> BinSizes:
        """Sizes of the tote."""
        height = tote.outer_size[2] - tote.wall
        return cls("tote", "tote", tote, tote.outer_size[:2], tote.floor_size, tote.rim_size, height, -tote.wall)

    @property
    def is_visible(self) -> bool:
        """Whether there is anything but the table."""
        return self.noun != "table"

    @property
    def corners(self) -> list[Point]:
        """Corners of the outer box (8)."""
        length, width = self.outer
        return list(itertools.product((-length / 2, length / 2), (-width / 2, width / 2), (self.base, self.height)))

    @property
    def centers(self) -> list[Sides]:
        """Centre of each compartment."""
        return [(0.0, 0.0)]

    @property
    def cell(self) -> Sides:
        """Inner floor of a compartment."""
        return self.floor

    @property
    def mouth(self) -> Sides:
        """Opening of a compartment."""
        return self.opening

    @property
    def inner_corners(self) -> list[Point]:
        """Corners of the inner floor and of the rim (8)."""
        levels = ((self.floor, 0.0), (self.opening, self.height))
        return [(x * length / 2, y * width / 2, z) for (length, width), z in levels for x, y in itertools.product((-1, 1), repeat=2)]


def recorded_bins(config: Config) -> tuple[str, ...]:
    """Names of the bins, where data sets record that of each episode; empty for a tote that is always in its place."""
    bins = config.bins
    moves = any(bins.shift) or bins.yaw > 0.0
    return tuple(sizes.name for sizes in bin_sizes(config)) if moves or bins.kind != TOTE else ()


def bin_sizes(config: Config) -> tuple[BinSizes, ...]:
    """Bins from which an episode draws its own; the first stands on the table, whose height follows from its base."""
    bins = config.bins
    if bins.kind == NONE:
        return (BinSizes("table", "table", None, bins.area, bins.area, bins.area, 0.0, 0.0, bins.margin),)
    if bins.kind == PALLET:
        length, width, height = bins.pallet_size
        return (BinSizes("pallet", "pallet", None, (length, width), bins.area, bins.area, 0.0, -height, bins.margin),)
    return (BinSizes.of_tote(config.tote),)
