"""Embedded props: a belt conveyor and a frame of aluminium profiles. Lengths [m]; both stand on a floor FLOOR below their
origins, which lie in the middle of the belt, and of the posts at its height."""

from functools import cache

import numpy as np

from synpick_warp.configs.cell.bins import CONVEYOR
from synpick_warp.scenes.modelling import Patch, Rect, at_height, block, ellipse, face, join, loft, make_mesh, solid
from synpick_warp.scenes.types import MAP_CENTER, Material, TriangleMesh

ALUMINIUM, STEEL, RUBBER, PLASTIC = range(4)
FINISHES = (((0.78, 0.79, 0.8), 1.0, 0.35), ((0.55, 0.57, 0.6), 1.0, 0.3), ((0.07, 0.08, 0.08), 0.0, 0.7), ((0.1, 0.1, 0.11), 0.0, 0.5))
"""Base colour [sRGB], metallic factor and roughness of anodized aluminium, brushed steel, a belt, and guides and feet."""
PROFILE, SLOT, GROOVE = 0.04, 0.008, 0.0055
"""Profile 40 with slots of 8 mm, and their depth without undercut."""
BELT, LENGTH, THICK, DRUM = 0.46, 2.4, 0.002, 0.035
"""Of the conveyor: width of the belt, for containers of 400 mm, its length and thickness, and radius of the drums."""
GUIDE, LIFT, STRUT, STRUTS = 0.012, 0.05, 0.006, 6
"""Thickness of the side guides, height of their middle over the belt, half width of the struts that hold them, and their number."""
LEG, FLOOR = 0.045, 0.74
"""Width of legs, and height of origins over the floor: that of a desk of fixed height (EN 527-1)."""
SPAN, HEIGHT = (1.6, 1.4), 2.1
"""Of the frame: length and width between the axes of its posts, and their height over the origin, for cameras 2 m over a bin."""
GAP = 5e-4
"""Gap between profiles, which are parts of their own so."""
POINTS = 24
"""Points of a drum's circle."""


def _finish(which: int) -> Rect:
    """Rectangle of a finish in the texture: the middle of its texel."""
    u = (which + 0.5) / len(FINISHES)
    return u, 0.5, u, 0.5


def _profile(axis: int, low: float, high: float, *middle: float) -> Patch:
    """Aluminium profile along an axis from `low` to `high`; `middle`: its place along the two axes that follow in turn."""
    half, slot, deep = PROFILE / 2, SLOT / 2, PROFILE / 2 - GROOVE
    side = [(half, -half), (half, -slot), (deep, -slot), (deep, slot), (half, slot)]
    ring = np.array([(c * a - s * b, s * a + c * b) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)) for a, b in side]) + middle
    ends = [at_height(ring, z) for z in (low, high)]
    made = join(face(ends[0][::-1]), loft(np.stack(ends)), face(ends[1]))
    return Patch(np.roll(made.corners, axis + 1, axis=2), np.broadcast_to(_finish(ALUMINIUM)[:2], made.uv.shape))


def _conveyor() -> Patch:
    """Belt conveyor along x: belt about two drums, rails with side guides, legs."""
    end, half, rail = LENGTH / 2, BELT / 2, BELT / 2 + PROFILE / 2
    circle, below = ellipse(2.0 * DRUM, 2.0 * DRUM, POINTS), -2.0 * DRUM
    parts = [block((-end, -half, z), (end, half, z + THICK), _finish(RUBBER)) for z in (-THICK, below)]
    for x in (-end, end):
        rings = [np.column_stack([circle[:, 0] + x, np.full(POINTS, y), circle[:, 1] - DRUM]) for y in (half, -half)]
        parts.append(solid(np.stack(rings), _finish(RUBBER)))
        foot = x - np.sign(x) * DRUM * 4
        for y in (-rail, rail):
            near, far = np.array((foot, y)) - LEG / 2, np.array((foot, y)) + LEG / 2
            parts.append(block((*near, -FLOOR), (*far, -PROFILE / 2), _finish(STEEL)))
    for y in (-rail, rail):
        parts += [_profile(0, -end, end, y, 0.0)]
        parts.append(block((-end, y - GUIDE / 2, LIFT - GUIDE), (end, y + GUIDE / 2, LIFT + GUIDE), _finish(PLASTIC)))
        for x in np.linspace(-end, end, STRUTS + 2)[1:-1]:
            parts.append(block((x - STRUT, y - STRUT / 2, PROFILE / 4), (x + STRUT, y + STRUT / 2, LIFT), _finish(STEEL)))
    return join(*parts)


def _frame() -> Patch:
    """Four posts, bars between their ends, and one across the middle that cameras hang from."""
    x, y, top = SPAN[0] / 2, SPAN[1] / 2, HEIGHT - PROFILE / 2
    inner = PROFILE / 2 + GAP
    posts = [_profile(2, -FLOOR, HEIGHT, side * x, other * y) for side in (-1, 1) for other in (-1, 1)]
    bars = [_profile(0, inner - x, x - inner, side * y, top) for side in (-1, 1)]
    return join(*posts, *bars, *(_profile(1, inner - y, y - inner, top, at) for at in (-x, 0.0, x)))


@cache
def make_embedded(name: str) -> tuple[TriangleMesh, Material]:
    """Make an embedded prop, once a process; nobody changes it."""
    color = np.array([[[round(255 * part) for part in color] for color, _, _ in FINISHES]], np.uint8)
    maps = [[(MAP_CENTER, MAP_CENTER, round(255 * roughness), round(255 * metallic)) for _, metallic, roughness in FINISHES]]
    mesh = make_mesh(_conveyor() if name == CONVEYOR else _frame(), centered=False)
    return mesh, Material((1.0, 1.0, 1.0), color, 0.0, 0.5, np.array(maps, np.uint8))
