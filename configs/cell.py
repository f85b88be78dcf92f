"""Extents of the bins that stand under the cameras, as the settings give them; a table and a pallet are bins without walls."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

from synpick_warp.configs.bins import NONE, OWN, PALLET, TOTE, BinRow, Tote
from synpick_warp.configs.schema import Config

Sides = tuple[float, float]
"""Length (along x) and width (along y) [m]."""
Point = tuple[float, float, float]
DIVIDER = 0.01
"""Thickness of dividers [m]: more than an object at physics.max_speed moves in one step."""


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
    compartments: tuple[int, int] = (1, 1)
    """Columns (along x) and rows (along y)."""
    divider_height: float = 0.0

    @classmethod
    def of_tote(cls, tote: Tote, name: str = TOTE, noun: str = TOTE) -> BinSizes:
        """Sizes of the tote, or of a box like it."""
        height = tote.outer_size[2] - tote.wall
        return cls(name, noun, tote, tote.outer_size[:2], tote.floor_size, tote.rim_size, height, -tote.wall)

    @classmethod
    def of_row(cls, row: BinRow) -> BinSizes:
        """Sizes of a row of [[bin]]."""
        sizes = cls.of_tote(row, row.name, "bin")
        return replace(sizes, weight=row.weight, compartments=row.compartments, divider_height=row.divider_height)

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
        """Centre of each compartment, column by column."""
        columns, rows = (
            [-side / 2 + cell / 2 + index * (cell + DIVIDER) for index in range(count)] if count > 1 else [0.0]
            for side, cell, count in zip(self.floor, self.cell, self.compartments, strict=True)
        )
        return list(itertools.product(columns, rows))

    @property
    def cell(self) -> Sides:
        """Inner floor of a compartment."""
        length, width = (
            (side - (count - 1) * DIVIDER) / count if count > 1 else side for side, count in zip(self.floor, self.compartments, strict=True)
        )
        return length, width

    @property
    def mouth(self) -> Sides:
        """Opening of a compartment: over its floor, where there are several."""
        return self.opening if self.compartments == (1, 1) else self.cell

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
    if bins.kind == OWN and config.bin:
        return tuple(BinSizes.of_row(row) for row in config.bin)
    return (BinSizes.of_tote(config.tote),)


def bin_tables(config: Config) -> dict[str, Tote]:
    """Tables of the bins with walls by their keys: tote, or bin[0] and so on."""
    if config.bins.kind == OWN:
        return {f"bin[{index}]": row for index, row in enumerate(config.bin)}
    return {TOTE: config.tote} if config.bins.kind == TOTE else {}
