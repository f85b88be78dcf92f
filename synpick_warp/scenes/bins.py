"""Bins that stand under the cameras: visual mesh with material and empty interior, collision shapes, guide walls; and the tote, a moulded
box with draft angle, rounded corners, flange and ribs.

All geometry is in the bin's own frame, of the tote the world frame: origin at the centre of the inner floor, z up.
"""

import functools
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from synpick_warp.configs.cell.bins import DIVIDER, TOTE, BinRow, BinSizes, Tote
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bin_meshes.colliders import FLOOR_DEPTH, MIN_WALL
from synpick_warp.scenes.bin_meshes.inside import HeightField
from synpick_warp.scenes.bin_meshes.reading import bin_material, read_bin
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.grippers import finger_fixture, make_head
from synpick_warp.scenes.modelling import Patch, at_height, block, join, loft, make_mesh, rounded_rectangle, solid, strips
from synpick_warp.scenes.types import ConvexPiece, Fixture, Interior, Material

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
    """Build bins. Raises ConfigError: the sizes of a bin do not fit each other, its mesh cannot be used or is not the one that was
    measured, or all bins together have more than MAX_SHAPES collision shapes."""
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
    mesh = make_mesh(join(*(block(low, high) for low, high in boxes)), centered=False)
    pieces = (box_piece((-length, -width, base), (length, width, 0.0)),) if sizes.is_visible else ()
    return Bin(sizes, Fixture(mesh, Material(WOOD, None, 0.0, WOOD_ROUGHNESS)), pieces)


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


CORNER_RADIUS = 0.02
"""Radius of the inner vertical edges at the floor [m], typical of moulded boxes; it grows upward as the draft opens the corner."""
CORNER_SEGMENTS = 8
"""Segments of a rounded corner."""
RIB_SPACING = 0.1
"""Spacing of the ribs under the flange [m]."""
RIB_HEIGHT = 0.3
"""Height of the ribs, as a fraction of the tote's."""
INTERIOR_MARGIN = 1e-4
"""Margin between interior and faces [m]: far above the rounding error of hit positions, below the offset of ray origins."""
TABLE_SIZE = (10.0, 10.0, 0.1)
"""Half extents of the table under the tote [m]; large enough for objects that leave the tote."""
FLOOR_DROP = 0.74
"""Height of the table above the floor [m]: that of a desk of fixed height (EN 527-1)."""
TABLE_ROUGHNESS = 0.8
"""Roughness of the table's material: matt. Its only setting is `render.table_color`."""


def rim_height(tote: Tote) -> float:
    """Height of the rim above the inner floor [m]."""
    return tote.outer_size[2] - tote.wall


def tote_fixture(tote: Tote, more: Sequence[Patch] = ()) -> Fixture:
    """Build the visual mesh: a closed shell for the tote, one for each rib, and `more`, with which its interior is not empty. Raises
    ConfigError: the rim does not fit into the outer size, the floor is larger than the rim or too small for its rounded corners, or the
    tote is lower than three walls."""
    _check(tote)
    wall, top = tote.wall, rim_height(tote)
    under = top - wall
    rim = rounded_rectangle(tote.outer_size[0], tote.outer_size[1], CORNER_RADIUS + tote.wall, CORNER_SEGMENTS)
    rings = np.stack(
        [
            _ring(tote, 0.0, wall, -wall),
            *(_ring(tote, fraction * under, wall, fraction * under) for fraction in np.linspace(0.0, 1.0, 4)),
            *(at_height(rim, z) for z in (under, top)),
            *(_ring(tote, fraction * top, 0.0, fraction * top) for fraction in np.linspace(1.0, 0.0, 4)),
        ]
    )
    shell = join(strips(rings[0], below=True), loft(rings), strips(rings[-1]))
    mesh = make_mesh(join(shell, *_ribs(tote), *more), centered=False)
    return Fixture(mesh, Material(tote.color, None, tote.metallic, tote.roughness), None if more else tote_interior(tote))


def tote_interior(tote: Tote) -> Interior:
    """Empty convex interior of the visual mesh: INTERIOR_MARGIN inside its walls and floor; round corners are cut by chords at 45°."""
    top = rim_height(tote)
    half = []
    for level in (0.0, top):
        (length, width), radius = _opening(tote, level)
        half.append(np.array((length, width, length + width - radius)) - INTERIOR_MARGIN * np.array((1.0, 1.0, np.sqrt(2.0))))
    growth = (half[1] - half[0]) / top
    return Interior(tuple(half[0].tolist()), tuple(growth.tolist()), INTERIOR_MARGIN, top + INTERIOR_MARGIN)


@functools.cache
def tote_colliders(tote: Tote) -> tuple[ConvexPiece, ...]:
    """Build the convex collision shapes: floor, four walls and four corners, with inner faces that coincide with the visual mesh.

    The walls follow the draft, from below the floor to the rim, and extend to the edge of the flange. A corner's inner face is one plane at
    45° tangent to the visible rounding, from which it deviates by at most 8 % of the radius. Raises ConfigError: as `tote_fixture`."""
    _check(tote)
    top = rim_height(tote)
    outer = np.maximum(np.array(tote.outer_size[:2]) / 2, np.array(tote.rim_size) / 2 + MIN_WALL)
    floor = box_piece((-outer[0], -outer[1], -FLOOR_DEPTH), (outer[0], outer[1], 0.0))
    walls = []
    for axis in (0, 1):
        inner, rim, out, along = tote.floor_size[axis] / 2, tote.rim_size[axis] / 2, outer[axis], outer[1 - axis]
        outline = ((inner, -FLOOR_DEPTH), (inner, 0.0), (rim, top), (out, top), (out, -FLOOR_DEPTH))
        for side in (1.0, -1.0):
            points = [(side * across, end, z) for across, z in outline for end in (-along, along)]
            walls.append(_piece(points if axis == 0 else [(y, x, z) for x, y, z in points]))
    return (floor, *walls, *(_corner(tote, x, y) for x in (1.0, -1.0) for y in (1.0, -1.0)))


def _corner(tote: Tote, x: float, y: float) -> ConvexPiece:
    """The wedge that fills a vertical edge up to the 45° tangent of its rounding; (x, y) are the signs of the corner."""
    points = []
    for level, z in ((0.0, -FLOOR_DEPTH), (0.0, 0.0), (rim_height(tote), rim_height(tote))):
        half, radius = _opening(tote, level)
        reach = (2.0 - np.sqrt(2.0)) * radius
        for along, across in ((-reach, 0.0), (0.0, -reach), (MIN_WALL, 0.0), (0.0, MIN_WALL), (MIN_WALL, MIN_WALL)):
            points.append((x * (half[0] + along), y * (half[1] + across), z))
    return _piece(points)


def _check(tote: Tote) -> None:
    """Check that floor, rim and walls of the tote fit into one another; raises ConfigError."""
    for axis, name in enumerate(("length", "width")):
        outer, rim, floor = tote.outer_size[axis], tote.rim_size[axis], tote.floor_size[axis]
        if rim + 2 * tote.wall >= outer:
            raise ConfigError(
                f"tote.rim_size: a {name} of {rim} m with walls of {tote.wall} m does not fit into tote.outer_size {outer} m; "
                "make it smaller"
            )
        if floor > rim:
            raise ConfigError(f"tote.floor_size: a {name} of {floor} m is larger than the rim's {rim} m; the tote must open upward")
        if floor <= 2 * CORNER_RADIUS:
            raise ConfigError(
                f"tote.floor_size: a {name} of {floor} m is too small for rounded corners; allowed: more than {2 * CORNER_RADIUS} m"
            )
    if tote.outer_size[2] <= 3 * tote.wall:
        raise ConfigError(f"tote.outer_size: a height of {tote.outer_size[2]} m must exceed three walls of {tote.wall} m; increase it")


def _ring(tote: Tote, level: float, offset: float, z: float) -> np.ndarray:
    """Rounded rectangle (n, 3) at height z [m]: the tote's inside at `level` [m] above the floor, moved outward by `offset` [m]."""
    (length, width), radius = _opening(tote, level)
    return at_height(rounded_rectangle(2 * (length + offset), 2 * (width + offset), radius + offset, CORNER_SEGMENTS), z)


def _opening(tote: Tote, level: float) -> tuple[np.ndarray, float]:
    """Inner half length and half width (2) at a level above the floor, and the radius of the corners [m]."""
    fraction = level / rim_height(tote)
    floor, rim = np.array(tote.floor_size), np.array(tote.rim_size)
    return (floor + fraction * (rim - floor)) / 2, CORNER_RADIUS + fraction * float((rim - floor).min()) / 2


def _ribs(tote: Tote) -> list[Patch]:
    """Triangular ribs between wall and flange; they end inside both, so that no faces are coplanar."""
    top = rim_height(tote) - tote.wall / 2
    bottom = top - RIB_HEIGHT * tote.outer_size[2]
    ribs = []
    for axis in (0, 1):
        slope = (tote.rim_size[axis] - tote.floor_size[axis]) / 2 / rim_height(tote)
        upper, lower = (tote.floor_size[axis] / 2 + slope * z + tote.wall / 2 for z in (top, bottom))
        edge = tote.outer_size[axis] / 2 - tote.wall / 4
        profile = np.array([(upper, top), (lower, bottom), (lower + tote.wall / 2, bottom), (edge, top)])
        straight = tote.floor_size[1 - axis] / 2 - 2 * CORNER_RADIUS
        count = max(1, int(2 * straight / RIB_SPACING) + 1)
        for position in np.linspace(-straight, straight, count) if count > 1 else (0.0,):
            # Extruded towards -y, since the profile (x, z) is clockwise about +y.
            rings = [np.column_stack([profile[:, 0], np.full(4, position + side * tote.wall / 2), profile[:, 1]]) for side in (1.0, -1.0)]
            rib = solid(np.stack(rings))
            ribs += [rib.rotate("z", angle + 90.0 * axis) for angle in (0.0, 180.0)]
    return ribs


def box_piece(low: tuple[float, float, float], high: tuple[float, float, float]) -> ConvexPiece:
    """Make a convex piece of the box between two corners."""
    return _piece([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _piece(points: list[tuple[float, float, float]]) -> ConvexPiece:
    return simplify_hull(np.array(points), len(points))
