"""The tote: a box with draft, rounded corners and a flange around its rim; and the walls that objects collide with.

Everything stands in the tote's frame: its origin is the centre of the inner floor, z up.
"""

from __future__ import annotations

import numpy as np

from synpick_warp.configs.schema import Tote
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.collision.hulls import simplify_hull
from synpick_warp.scenes.embedded.meshes import Patch, join, loft, make_mesh, rounded_rectangle, solid, strips
from synpick_warp.scenes.types import ConvexPiece, Fixture, Interior, Material

CORNER_RADIUS = 0.02
"""Radius of the inner vertical edges at the floor [m], as moulded boxes have it; it grows by as much as the draft opens the corner."""
CORNER_SEGMENTS = 8
RIB_SPACING = 0.1
"""Distance of the ribs under the flange [m]."""
RIB_HEIGHT = 0.3
"""Height of the ribs, as a share of the tote's."""
FLOOR_DEPTH = 0.1
"""Thickness of the floor's collision shape [m]: more than anything falls through in one step."""
MIN_WALL = 0.02
"""Least thickness of the walls' collision shapes at the rim [m], for the same reason."""
INTERIOR_MARGIN = 1e-4
"""Far more than positions of hits are off by rounding, and less than rays start off a surface [m]."""
GUIDE_THICKNESS = 0.1
"""Thickness of the guide walls [m]."""
TABLE_SIZE = (10.0, 10.0, 0.1)
"""Half size and half thickness of the table on which the tote stands [m]; large enough for whatever leaves the tote."""
TABLE_ROUGHNESS = 0.8
"""Roughness of the table's material: matt. Its only setting is `render.table_color`."""


def rim_height(tote: Tote) -> float:
    """Height of the rim above the inner floor [m]."""
    return tote.outer_size[2] - tote.wall


def tote_fixture(tote: Tote) -> Fixture:
    """The visible tote: one closed shell and a closed shell for each rib.

    Raises:
        ConfigError: The rim does not fit into the outer size, or the floor is larger than the rim.
    """
    _check(tote)
    wall, top = tote.wall, rim_height(tote)
    under = top - wall
    rings = np.stack(
        [
            _ring(tote, 0.0, wall, -wall),
            *(_ring(tote, share * under, wall, share * under) for share in np.linspace(0.0, 1.0, 4)),
            _outer_ring(tote, under),
            _outer_ring(tote, top),
            *(_ring(tote, share * top, 0.0, share * top) for share in np.linspace(1.0, 0.0, 4)),
        ]
    )
    shell = join(strips(rings[0], below=True), loft(rings), strips(rings[-1]))
    mesh = make_mesh(join(shell, *_ribs(tote)), centered=False)
    return Fixture(mesh, Material(tote.color, None, tote.metallic, tote.roughness), tote_interior(tote))


def tote_interior(tote: Tote) -> Interior:
    """The room in the visible tote, INTERIOR_MARGIN off its faces; chords cut off its round corners."""
    top = rim_height(tote)
    half = []
    for level in (0.0, top):
        (length, width), radius = _opening(tote, level)
        half.append(np.array((length, width, length + width - radius)) - INTERIOR_MARGIN * np.array((1.0, 1.0, np.sqrt(2.0))))
    growth = (half[1] - half[0]) / top
    return Interior(tuple(half[0].tolist()), tuple(growth.tolist()), INTERIOR_MARGIN, top + INTERIOR_MARGIN)


def tote_colliders(tote: Tote) -> tuple[ConvexPiece, ...]:
    """Floor, four walls and four corners; floor and walls have the inner faces of the visible tote.

    The walls lean outward with the draft, reach from below the floor to the rim, and outward to the edge of the flange. A corner is
    one plane at 45° that touches the visible round: nowhere is there more room than is seen, but for 8 % of the round's radius.

    Raises:
        ConfigError: As `tote_fixture`.
    """
    _check(tote)
    top = rim_height(tote)
    outer = np.maximum(np.array(tote.outer_size[:2]) / 2, np.array(tote.rim_size) / 2 + MIN_WALL)
    floor = _box((-outer[0], -outer[1], -FLOOR_DEPTH), (outer[0], outer[1], 0.0))
    walls = []
    for axis in (0, 1):
        inner, rim, out, along = tote.floor_size[axis] / 2, tote.rim_size[axis] / 2, outer[axis], outer[1 - axis]
        outline = ((inner, -FLOOR_DEPTH), (inner, 0.0), (rim, top), (out, top), (out, -FLOOR_DEPTH))
        for side in (1.0, -1.0):
            points = [(side * across, end, z) for across, z in outline for end in (-along, along)]
            walls.append(_piece(points if axis == 0 else [(y, x, z) for x, y, z in points]))
    return (floor, *walls, *(_corner(tote, x, y) for x in (1.0, -1.0) for y in (1.0, -1.0)))


def _corner(tote: Tote, x: float, y: float) -> ConvexPiece:
    """The wedge that fills a vertical edge up to the tangent at 45° of its round; (x, y) are the signs of the corner."""
    points = []
    for level, z in ((0.0, -FLOOR_DEPTH), (0.0, 0.0), (rim_height(tote), rim_height(tote))):
        half, radius = _opening(tote, level)
        reach = (2.0 - np.sqrt(2.0)) * radius
        for along, across in ((-reach, 0.0), (0.0, -reach), (MIN_WALL, 0.0), (0.0, MIN_WALL), (MIN_WALL, MIN_WALL)):
            points.append((x * (half[0] + along), y * (half[1] + across), z))
    return _piece(points)


def guide_walls(tote: Tote, height: float) -> tuple[ConvexPiece, ...]:
    """Four upright walls on the rim that keep a drop column over the tote, flush with the opening; height [m]."""
    low = rim_height(tote)
    x, y = tote.rim_size[0] / 2, tote.rim_size[1] / 2
    far_x, far_y, high = x + GUIDE_THICKNESS, y + GUIDE_THICKNESS, low + height
    return (
        _box((x, -far_y, low), (far_x, far_y, high)),
        _box((-far_x, -far_y, low), (-x, far_y, high)),
        _box((-far_x, y, low), (far_x, far_y, high)),
        _box((-far_x, -far_y, low), (far_x, -y, high)),
    )


def _check(tote: Tote) -> None:
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
                f"tote.floor_size: a {name} of {floor} m leaves no room for round corners; take more than {2 * CORNER_RADIUS} m"
            )
    if tote.outer_size[2] <= 3 * tote.wall:
        raise ConfigError(
            f"tote.outer_size: a height of {tote.outer_size[2]} m is no more than three walls of {tote.wall} m; make it higher"
        )


def _ring(tote: Tote, level: float, offset: float, z: float) -> np.ndarray:
    """Outline (n, 3) of the inside at a level above the floor, widened by an offset, drawn at height z [m]."""
    (length, width), radius = _opening(tote, level)
    outline = rounded_rectangle(2 * (length + offset), 2 * (width + offset), radius + offset, CORNER_SEGMENTS)
    return np.column_stack([outline, np.full(len(outline), z)])


def _opening(tote: Tote, level: float) -> tuple[np.ndarray, float]:
    """Half length and half width (2) of the inside at a level above the floor, and the radius of its corners [m]."""
    share = level / rim_height(tote)
    floor, rim = np.array(tote.floor_size), np.array(tote.rim_size)
    return (floor + share * (rim - floor)) / 2, CORNER_RADIUS + share * float((rim - floor).min()) / 2


def _outer_ring(tote: Tote, z: float) -> np.ndarray:
    outline = rounded_rectangle(tote.outer_size[0], tote.outer_size[1], CORNER_RADIUS + tote.wall, CORNER_SEGMENTS)
    return np.column_stack([outline, np.full(len(outline), z)])


def _ribs(tote: Tote) -> list[Patch]:
    """Triangular ribs between wall and flange; they end inside both, so that nothing coincides."""
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
        for place in np.linspace(-straight, straight, count) if count > 1 else (0.0,):
            # Along +y the profile (x, z) runs clockwise about the way it is pushed, so it is pushed towards -y.
            rings = [np.column_stack([profile[:, 0], np.full(4, place + side * tote.wall / 2), profile[:, 1]]) for side in (1.0, -1.0)]
            rib = solid(np.stack(rings))
            ribs += [rib.turned("z", turn + 90.0 * axis) for turn in (0.0, 180.0)]
    return ribs


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> ConvexPiece:
    return _piece([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _piece(points: list[tuple[float, float, float]]) -> ConvexPiece:
    return simplify_hull(np.array(points), len(points))
