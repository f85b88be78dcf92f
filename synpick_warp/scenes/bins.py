"""Bins that stand under the cameras: visual mesh with material and empty interior, collision shapes, guide walls."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from synpick_warp.configs.cell.bins import TOTE, BinRow, Tote
from synpick_warp.configs.cell.extents import DIVIDER, BinSizes, Point
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bin_meshes.inside import HeightField
from synpick_warp.scenes.bin_meshes.reading import bin_material, read_bin
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.grippers.mechanism import finger_fixture
from synpick_warp.scenes.grippers.registry import make_head
from synpick_warp.scenes.modelling import Patch, at_height, join, make_mesh, solid
from synpick_warp.scenes.tote import box_piece, tote_colliders, tote_fixture
from synpick_warp.scenes.types import ConvexPiece, Fixture, Material

GUIDES, GUIDE_THICKNESS = 4, 0.1
"""Number of guide walls, and their thickness [m]."""
CROSSING = 1e-4
"""Difference in height of crossing dividers [m]."""
BOARD, BOARD_GAP, BOARDS = 0.022, 0.006, 5
"""Thickness of a pallet's boards (EN 13698-1) [m], gap between those of the deck [m], and their number."""
MAX_SHAPES = 256
"""Collision shapes of all bins: each world has all of them, and the broad phase takes time with the square of their number."""
RUNNER = 0.16
"""Width of a pallet's runners, as a fraction of its length."""
WOOD, WOOD_ROUGHNESS = (0.66, 0.52, 0.36), 0.8
"""Colour (sRGB) and roughness of a pallet: raw softwood."""


@dataclass(frozen=True, eq=False)
class Bin:
    """A bin in its own frame: origin at the centre of the inner floor, z up."""

    sizes: BinSizes
    fixture: Fixture
    """Visual mesh, material and empty interior."""
    pieces: tuple[ConvexPiece, ...]
    """Collision shapes."""
    limits: HeightField | None = None
    """Heights below which an object is outside; None: the inside is a box."""
    notes: tuple[str, ...] = ()
    """Lines on a mesh that was read."""

    @property
    def is_detailed(self) -> bool:
        """Whether it has other collision shapes than a box's floor, walls and corners."""
        return self.sizes.measured is not None or self.sizes.compartments != (1, 1)


def make_bins(sizes: Iterable[BinSizes]) -> tuple[Bin, ...]:
    """Build bins.

    Raises:
        ConfigError: The sizes of a bin do not fit each other, its mesh cannot be used or is not the one that was measured, or all bins
            together have more than MAX_SHAPES collision shapes.
    """
    bins = tuple(map(_make_bin, sizes))
    if (count := sum(len(one.pieces) for one in bins)) > MAX_SHAPES:
        raise ConfigError(f"{len(bins)} bins have {count} collision shapes; allowed: {MAX_SHAPES}; use fewer, or simplify their meshes")
    return bins


def _make_bin(sizes: BinSizes) -> Bin:
    """Build a bin, of its mesh if it has one."""
    shell = sizes.shell
    if shell is None:
        return _make_pallet(sizes)
    if not isinstance(shell, BinRow) or not shell.file:
        return _make_box(sizes, shell)
    model = read_bin(shell)
    if model.measured != sizes.measured:
        raise ConfigError(
            f"bin {sizes.name}: {shell.file} is not the mesh that was measured; restore it, or bake again into another folder"
        )
    return Bin(sizes, Fixture(model.mesh, bin_material(model, shell)), model.pieces, model.limits, model.notes)


def _make_box(sizes: BinSizes, shell: Tote) -> Bin:
    """Build an open box with dividers."""
    try:
        dividers = _dividers(sizes, shell)
        patches = [solid(np.stack(rings)) for rings in dividers]
        pieces = tuple(simplify_hull(np.concatenate(rings), 8) for rings in dividers)
        return Bin(sizes, tote_fixture(shell, patches), (*tote_colliders(shell), *pieces))
    except ConfigError as error:
        raise ConfigError(f"{error}" if sizes.name == TOTE else f"bin {sizes.name}: {str(error).removeprefix('tote.')}") from error


def _dividers(sizes: BinSizes, shell: Tote) -> list[list[np.ndarray]]:
    """Lower and upper outline (4, 3) of each divider. They end inside walls and floor, so that no faces are coplanar."""
    found = []
    for axis, count in enumerate(sizes.compartments):
        pitch, other = sizes.cell[axis] + DIVIDER, 1 - axis
        for index in range(1, count):
            middle = -sizes.floor[axis] / 2 - DIVIDER / 2 + index * pitch
            rings = []
            # Rows are lower by a hair, so that tops do not coincide where dividers cross.
            for z in (-shell.wall / 2, sizes.divider_height - axis * CROSSING):
                end = (sizes.floor[other] + max(z, 0.0) / sizes.height * (sizes.opening[other] - sizes.floor[other]) + shell.wall) / 2
                ring = np.array([(-DIVIDER / 2, -end), (DIVIDER / 2, -end), (DIVIDER / 2, end), (-DIVIDER / 2, end)])
                ring[:, 0] += middle
                rings.append(at_height(ring if axis == 0 else ring[::-1, ::-1], z))
            found.append(rings)
    return found


def _make_pallet(sizes: BinSizes) -> Bin:
    """Build a pallet of deck boards on three runners; its collision shape is one box. A table has none, and its mesh is never rendered."""
    length, width = (side / 2 for side in sizes.outer)
    base = min(sizes.base, -2.0 * BOARD)
    edges = np.linspace(-width, width + BOARD_GAP, BOARDS + 1)
    boxes = [((-length, low, -BOARD), (length, high - BOARD_GAP, 0.0)) for low, high in itertools.pairwise(edges.tolist())]
    # The runners' tops end inside the boards, so that no faces are coplanar.
    runners = (-length, -RUNNER * length, length - 2 * RUNNER * length)
    boxes += [((x, -width, base), (x + 2 * RUNNER * length, width, -BOARD / 2)) for x in runners]
    mesh = make_mesh(join(*(_box_patch(low, high) for low, high in boxes)), centered=False)
    pieces = (box_piece((-length, -width, base), (length, width, 0.0)),) if sizes.is_visible else ()
    return Bin(sizes, Fixture(mesh, Material(WOOD, None, 0.0, WOOD_ROUGHNESS)), pieces)


def _box_patch(low: Point, high: Point) -> Patch:
    """Closed surface of the box between two corners."""
    ring = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    return solid(np.stack([at_height(ring, low[2]), at_height(ring, high[2])]))


def guide_walls(sizes: BinSizes, height: float) -> tuple[ConvexPiece, ...]:
    """Build GUIDES temporary walls on the rim, flush with the opening, that keep falling objects over the bin; height [m]."""
    low = sizes.height
    x, y = sizes.opening[0] / 2, sizes.opening[1] / 2
    far_x, far_y, high = x + GUIDE_THICKNESS, y + GUIDE_THICKNESS, low + height
    return (
        box_piece((x, -far_y, low), (far_x, far_y, high)),
        box_piece((-far_x, -far_y, low), (-x, far_y, high)),
        box_piece((-far_x, y, low), (far_x, far_y, high)),
        box_piece((-far_x, -far_y, low), (far_x, -y, high)),
    )


def make_fixtures(bins: Sequence[Bin], gripper: Gripper) -> tuple[Fixture, ...]:
    """Create the visual meshes and materials of all bins, the gripper shaft and the gripper head, in this order."""
    return (*(one.fixture for one in bins), finger_fixture(gripper), make_head(gripper).fixture)
