"""Compartments of a bin's mesh: opening and floor of each, and the sides along which a turned bin lies.

An opening is the largest rectangle between the walls just below the rim, or the top of the dividers; a floor is the largest on which
parts can lie, at the foot of walls that lean. With upright walls alone both are whole cells of the height field; otherwise they end where
triangles of walls meet floor and rim.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from trimesh import Trimesh
from trimesh.intersections import mesh_plane

from synpick_warp.scenes.bin_meshes.inside import HOLE, MIN_DEPTH, BinSurface
from synpick_warp.system.linear_algebra import DECIMALS, dot, lstsq

MIN_SIDE = 0.03
"""Least length and width of a compartment [m], as of those that are given by sizes."""
DIVIDER_SHARE = 0.25
"""Least height of a divider above the floors that it parts, as a fraction of the inside's depth: lower ones are ribs."""
LEVELS = 48
"""Levels at which dividers are looked for."""
BELOW = 1e-5
"""How far below a level openings are measured there [m]."""
MIDDLE = 0.1
"""Width of the band through the middle of a floor in which its sides are measured, as a fraction of it."""
PARALLEL = 0.2
"""Angle within which edges of an outline are parallel [°]."""
ALIGNED_SHARE, SMALLER = 0.55, 0.9
"""A bin is turned if this fraction of its outline lies along its sides, or if the rectangle about it along them is so much smaller than
that along the axes; a round bin has neither."""
SQUARE = 0.999
"""Ratio of the sides from which on a bin is square: its sides have no order."""

Rectangle = tuple[float, float, float, float]
"""Centre x, y, length and width [m]."""


class Compartment(NamedTuple):
    """Room between walls and dividers."""

    opening: Rectangle
    """At `level`."""
    floor: Rectangle
    span: Rectangle
    """The floor from wall to wall, through its middle: longer than `floor` where corners are rounded."""
    plane: tuple[float, float, float]
    """Height of the floor, z = a x + b y + c."""
    level: float
    """Height of the rim or, of several compartments, below the top of the dividers [m]."""
    leans: bool
    """Whether opening and floor differ."""


def find_compartments(surface: BinSurface) -> list[Compartment]:
    """Compartments of a surface, sorted by x and y; empty: none is as wide as MIN_SIDE.

    Connected components of the inside below a height, at the height with most of them (the highest one if several have as many)."""
    depth = surface.rim - surface.floor
    best: list[tuple[np.ndarray, np.ndarray, float]] = []
    for level in np.linspace(surface.rim, surface.floor, LEVELS, endpoint=False):
        below = surface.inside & (surface.height < level - 1e-6)
        labels, count = ndimage.label(below)
        if count <= len(best):
            continue
        deepest = ndimage.minimum(surface.height, labels, np.arange(1, count + 1))
        deep = np.flatnonzero(level - deepest >= DIVIDER_SHARE * depth) + 1
        found = [(_largest_rectangle(surface, labels == one), labels == one, float(level)) for one in deep] if len(deep) > len(best) else []
        found = [one for one in found if np.ptp(one[0], axis=0).min() >= MIN_SIDE]
        best = found if len(found) > len(best) else best
    return sorted(_measure(surface, *one) for one in best)


def _measure(surface: BinSurface, opening: np.ndarray, cells: np.ndarray, level: float) -> Compartment:
    """Measure opening and floor of a compartment of cells (nx, ny), whose opening is known to whole cells (2, 2)."""
    floor, flat, height = _find_floor(surface, cells, level)
    span, leans = floor, bool((np.abs(opening - floor) > 0.5 * surface.cell).any())
    plane = (0.0, 0.0, height) if height is not None else _fit_plane(surface, to_rectangle(floor))
    if leans:
        (x, y, z), (a, b, c) = surface.feet.T, plane
        feet = surface.feet[z >= a * x + b * y + c - 2.0 * surface.cell * math.hypot(a, b) - BELOW]
        span = _stretch(surface, floor, flat, feet)
        floor = _widen(floor, feet, surface.cell)
        opening = _widen(opening, _cross_section(surface, level - BELOW), surface.cell)
    return Compartment(to_rectangle(opening), to_rectangle(floor), to_rectangle(span), plane, level, leans)


def to_rectangle(corners: np.ndarray) -> Rectangle:
    """Centre and sides of a rectangle between two corners (2, 2) [m]."""
    center, sides = corners.mean(axis=0), corners[1] - corners[0]
    return float(center[0]), float(center[1]), float(sides[0]), float(sides[1])


def find_opening(surface: BinSurface, compartments: list[Compartment]) -> np.ndarray:
    """Corners (2, 2) of the box about the inside at the rim [m]."""
    cells = np.argwhere(surface.inside)
    box = surface.low + np.stack([cells.min(axis=0), cells.max(axis=0) + 1]) * surface.cell
    leans = any(one.leans for one in compartments)
    return _widen(box, _cross_section(surface, surface.rim - BELOW), surface.cell, MIDDLE) if leans else box


def enclose(rectangles: Sequence[Rectangle]) -> np.ndarray:
    """Corners (2, 2) of the box about rectangles."""
    each = np.array(rectangles)
    return np.stack([(each[:, :2] - each[:, 2:] / 2.0).min(axis=0), (each[:, :2] + each[:, 2:] / 2.0).max(axis=0)])


def _find_floor(surface: BinSurface, cells: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray, float | None]:
    """Corners (2, 2) of the floor among cells (nx, ny), its cells, and its height where it is none but a level between slopes.

    The floor is what is flat, no higher than halfway to the rim, and without steps of more than MIN_DEPTH; of several the largest.
    """
    height, solid, size = surface.ground, surface.solid, round(HOLE / surface.cell) // 2 * 2 + 1
    lowest = float(height[cells & solid].min(initial=np.inf)) if surface.has_floor else surface.floor
    low = cells & (height <= (lowest + surface.rim) / 2.0)
    flat = low & ((solid & ~surface.wall) | (~solid & (height <= lowest + MIN_DEPTH)))
    # Ribs and embossing have slopes, too.
    ribs = low & (height <= lowest + DIVIDER_SHARE * (surface.rim - lowest))
    flat = flat | np.logical_and(ndimage.binary_closing(flat, np.ones((size, size), bool)), ribs)
    level_holes = np.where(solid | ~flat, height, lowest)
    levelled = ndimage.grey_opening(np.where(cells, level_holes, surface.rim), size)
    step = levelled - ndimage.minimum_filter(np.where(flat & solid, levelled, np.inf), 3) > max(MIN_DEPTH, 3.0 * surface.cell)
    labels, count = ndimage.label(flat & ~step)
    found = [(_largest_rectangle(surface, labels == label), labels == label, None) for label in range(1, count + 1)]
    found = [one for one in found if np.ptp(one[0], axis=0).min() >= MIN_SIDE]
    if found:
        return max(found, key=lambda one: float(np.prod(one[0][1] - one[0][0])))
    for upper in np.linspace(lowest, level, LEVELS + 1)[1:-1]:
        below = cells & (height < upper)
        corners = _largest_rectangle(surface, below)
        if np.ptp(corners, axis=0).min() >= MIN_SIDE:
            return corners, below, float(upper)
    return _largest_rectangle(surface, cells), cells, None


def _stretch(surface: BinSurface, floor: np.ndarray, flat: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Floor (2, 2) extended from wall to wall in a narrow band through its middle: larger than `floor` where corners are rounded."""
    center, half, result = floor.mean(axis=0), (floor[1] - floor[0]) / 2.0, floor.copy()
    for end, axis in np.ndindex(2, 2):
        step = (2 * end - 1) * surface.cell
        line = np.linspace(center - MIDDLE * half, center + MIDDLE * half, 9)
        line[:, axis] = floor[end, axis] + step / 2.0
        while flat[surface.index(line)].all():
            line[:, axis] += step
        result[end, axis] = line[0, axis] - step / 2.0
    return _widen(result, points, surface.cell, MIDDLE)


def find_holes(surface: BinSurface) -> np.ndarray:
    """Sides (N, 2) of the largest rectangles in holes of the inside that are wider than HOLE [m]."""
    labels, count = ndimage.label(surface.inside & ~surface.solid)
    # Cells that a hole covers in part belong to its edge.
    found = [np.ptp(_largest_rectangle(surface, labels == label), axis=0) + surface.cell for label in range(1, count + 1)]
    return np.array([one for one in found if one.min() >= HOLE]).reshape(-1, 2)


def _widen(corners: np.ndarray, points: np.ndarray, cell: float, share: float = 1.0) -> np.ndarray:
    """Refine a rectangle (2, 2) known to a cell: move each side to the innermost wall point (N, 3) near it, within the middle `share`."""
    result, center, reach = corners.copy(), corners.mean(axis=0), share * ((corners[1] - corners[0]) / 2.0 - cell)
    for end, axis in np.ndindex(2, 2):
        along, sign = points[:, 1 - axis], 2 * end - 1
        beside = points[np.abs(along - center[1 - axis]) < reach[1 - axis], axis]
        gaps = sign * (beside - corners[end, axis])
        gaps = gaps[(gaps > -cell) & (gaps < 2.0 * cell)]
        result[end, axis] += sign * gaps.min(initial=2.0 * cell) if len(gaps) else 0.0
    return result


def _cross_section(surface: BinSurface, level: float) -> np.ndarray:
    """Points (N, 3) of walls at a height, at most half a cell apart."""
    walls = Trimesh(surface.walls.reshape(-1, 3), np.arange(surface.walls.size // 3).reshape(-1, 3), process=False)
    if walls.is_empty:
        return np.zeros((0, 3))
    lines = np.asarray(mesh_plane(walls, (0.0, 0.0, 1.0), (0.0, 0.0, level))).reshape(-1, 2, 3)
    longest = float(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).max(initial=0.0))
    shares = np.linspace(0.0, 1.0, 2 + int(longest / (0.5 * surface.cell)))[:, None, None]
    return ((1.0 - shares) * lines[:, 0] + shares * lines[:, 1]).reshape(-1, 3)


def _largest_rectangle(surface: BinSurface, cells: np.ndarray) -> np.ndarray:
    """Lower and upper corner (2, 2) of the largest axis-aligned rectangle within cells (nx, ny) [m]."""
    best, found = 0, (0, 0, 0, 0)
    used = np.flatnonzero(cells.any(axis=1))
    for first in range(int(used[0]), int(used[-1]) + 1) if len(used) else ():
        free = np.logical_and.accumulate(cells[first : used[-1] + 1], axis=0)
        free = free[: int(free.any(axis=1).sum())]
        # Length of the run of free cells that ends at each cell.
        order = np.arange(1, free.shape[1] + 1)
        runs = order - np.maximum.accumulate(np.where(free, 0, order), axis=1)
        sizes = runs * np.arange(1, len(free) + 1)[:, None]
        if sizes.size and sizes.max() > best:
            count, end = np.unravel_index(sizes.argmax(), sizes.shape)
            best, found = int(sizes.max()), (first, first + int(count) + 1, int(end) + 1 - int(runs[count, end]), int(end) + 1)
    x0, x1, y0, y1 = found
    return surface.low + np.array([(x0, y0), (x1, y1)]) * surface.cell


def _fit_plane(surface: BinSurface, rectangle: Rectangle) -> tuple[float, float, float]:
    """Plane z = a x + b y + c of a compartment's floor: least squares, then raised until at most 5 % of the cells rise above it.

    Fitted to the cells of the rectangle's inner part that are closer to the lowest point than to the rim."""
    x, y, length, width = rectangle
    cells = np.argwhere(surface.inside)
    near = (np.abs(surface.centers(cells) - (x, y)) <= 0.4 * np.array((length, width))).all(axis=1)
    solid = near & (surface.solid[tuple(cells.T)] == surface.has_floor)
    near = solid if solid.any() else near
    points, heights = surface.centers(cells), surface.ground[tuple(cells.T)]
    points, heights = points[near], heights[near]
    low = heights <= (heights.min() + surface.rim) / 2.0
    points, heights = points[low], heights[low]
    terms = np.column_stack([points, np.ones(len(points))])
    plane = lstsq(terms, heights, 1e-6)
    # Single cells on ribs or at walls do not count.
    above = float(np.quantile(heights - dot(terms, plane), 0.95))
    return float(plane[0]), float(plane[1]), float(plane[2] + max(above, 0.0))


def find_turn(corners: np.ndarray) -> float:
    """Angle about z [°] from the x axis to the longer side of a mesh of triangles (F, 3, 3), in (-90, 90]; 0 along the axes, or if round.

    Sides are edges of the convex hull of the outline: along most of it, or of the enclosing rectangle of least area (Freeman and Shapira,
    1975).
    """
    outline = corners[..., :2].reshape(-1, 2)
    try:
        outline = outline[ConvexHull(outline).vertices]
    except QhullError:
        return 0.0
    edges = np.roll(outline, -1, axis=0) - outline
    lengths, angles = np.hypot(*edges.T), np.degrees(np.arctan2(edges[:, 1], edges[:, 0])).round(DECIMALS - 3)  # In degrees.
    offset = (angles[:, None] - angles + 45.0) % 90.0 - 45.0
    shares = np.where(np.abs(offset) < PARALLEL, lengths[:, None], 0.0).sum(axis=0) / lengths.sum()
    areas = np.array([np.prod(_box_sides(outline, angle)) for angle in angles]).round(DECIMALS)
    aligned = int(shares.argmax())
    if shares[aligned] <= ALIGNED_SHARE:
        aligned = int(areas.argmin())
        if areas[aligned] > SMALLER * np.prod(_box_sides(outline, 0.0)):
            return 0.0
    near = np.abs(offset[:, aligned]) < PARALLEL
    angle = float(angles[aligned] + (lengths * offset[:, aligned])[near].sum() / lengths[near].sum())
    angle = round((angle + 45.0) % 90.0 - 45.0, 4)
    if abs(angle) < PARALLEL:
        return 0.0
    length, width = _box_sides(outline, angle)
    return angle if length >= SQUARE * width else angle - math.copysign(90.0, angle)


def _box_sides(points: np.ndarray, angle: float) -> np.ndarray:
    """Sides (2) of the box about points (N, 2) along axes that are turned by an angle [°]."""
    return np.ptp(turned(points, -angle), axis=0)


def turned(vectors: np.ndarray, angle: float) -> np.ndarray:
    """Vectors (N, 2 or 3) turned about z by an angle [°]."""
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    x, y = vectors[:, 0], vectors[:, 1]
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, *vectors[:, 2:].T])
