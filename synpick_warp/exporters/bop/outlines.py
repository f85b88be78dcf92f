"""Boundary tracing of masks: polygons along the borders of pixels, with holes and parts joined by bridges (keyhole polygons).

A polygon of a part with holes is one closed line: a bridge leads from the outline to each hole and back. It is exact: whoever fills it by
the even-odd rule gets the mask. Runs in writer processes, so it imports neither Warp nor Newton.
"""

from typing import NamedTuple

import numpy as np

from synpick_warp.exporters.writing.rle import Runs

_OFFSETS = np.array([-0.1, 0.05, -0.55])
"""Distance from a vertex to a coordinate below the middle of a pixel of the mask, by `Polygon.inward`: 0, 1, -1 [px]."""


class Polygon(NamedTuple):
    """Closed polygon around a mask: vertices on the borders of pixels [px], and on which side of each the mask lies."""

    points: np.ndarray
    """Vertices (x, y) on the borders of pixels; bridges begin in the middle of a pixel's side (N, 2) float64 [px]."""
    inward: np.ndarray
    """Direction along each axis in which the mask lies: -1, 1, or 0 at bridges (N, 2) int8."""

    def at_pixels(self) -> np.ndarray:
        """Vertices moved into the pixels of the mask at its border, left and above of their centres (N, 2) [px].

        Cut or rounded, coordinates are the indices of these pixels; readers that also fill those below the line get the mask.
        """
        return self.points + _OFFSETS[self.inward]


def trace_outlines(mask: Runs) -> list[Polygon]:
    """Trace the outlines of a mask, clockwise, one polygon for each part whose pixels share sides, the largest box first."""
    box = mask.box()
    if box is None:
        return []
    loops = _trace_loops(_fill_crop(mask, box))
    holes = sorted((loop for loop, hole in loops if hole), key=lambda loop: loop.points[:, 0].min())
    parts = [loop for loop, hole in loops if not hole]
    for hole in holes:
        _cut_hole(parts, hole)
    parts.sort(key=lambda part: -np.prod(np.ptp(part.points, axis=0)))
    return [Polygon(points + np.array(box[:2]), inward) for points, inward in parts]


def join_parts(parts: list[Polygon]) -> Polygon:
    """Join polygons to one by bridges between their nearest vertices."""
    joined, *others = parts
    for other in others:
        gaps = np.abs(joined.points[:, None] - other.points[None]).sum(axis=2)
        at, start = np.unravel_index(int(gaps.argmin()), gaps.shape)
        around = np.append(np.roll(np.arange(len(other.points)), -start), start)
        ends = Polygon(other.points[around], other.inward[around]), Polygon(joined.points[at : at + 1], joined.inward[at : at + 1])
        joined = _insert(joined, int(at) + 1, *ends)
    return joined


def _fill_crop(mask: Runs, box: tuple[int, int, int, int]) -> np.ndarray:
    """Image of a mask within its box, with a border of one pixel (H + 2, W + 2) bool."""
    left, top, right, bottom = box
    steps = np.zeros((bottom - top + 3, right - left + 3), np.int8)
    steps[mask.first - top + 1, mask.column - left + 1] += 1
    steps[mask.past - top + 1, mask.column - left + 1] -= 1
    return np.cumsum(steps, axis=0, dtype=np.int8).astype(bool)


def _trace_loops(image: np.ndarray) -> list[tuple[Polygon, bool]]:
    """Closed loops along the borders of a mask (H, W) bool whose border is False, with the mask on the right, and whether it is a hole.

    Each corner of a loop ends a horizontal and a vertical side. Along a line, corners in order are pairwise the ends of its sides.
    """
    y, x, right, lower = _find_corners(image)
    below, beside = image[1:, :][y, x + right], image[:, 1:][y + lower, x]
    mates = []
    for order in (np.lexsort((right, x, y)), np.lexsort((lower, y, x))):
        mate = np.empty_like(order)
        mate[order[0::2]], mate[order[1::2]] = order[1::2], order[0::2]
        mates.append(mate.tolist())
    points = np.stack((x, y), axis=1).astype(np.float64)
    inward = np.where(np.stack((beside, below), axis=1), 1, -1).astype(np.int8)
    loops, free = [], np.ones(len(x), bool)
    for first in np.lexsort((x, y)).tolist():
        if free[first]:
            loop, corner, turn = [first], mates[0][first], 1
            while corner != first:
                loop.append(corner)
                corner, turn = mates[turn][corner], 1 - turn
            free[loop] = False
            # Its upper left corner: the mask is below, or it is a hole, around which the mask lies on the right the other way round.
            hole = not below[first]
            order = loop[::-1] if hole else loop
            loops.append((Polygon(points[order], inward[order]), hole))
    return loops


def _find_corners(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corners of a mask's outlines: y, x, and whether the horizontal side goes right, and the vertical one down, from there (N) int64.

    Where two pixels touch at a corner alone, each has a corner of its own.
    """
    a, b, c, d = image[:-1, :-1], image[:-1, 1:], image[1:, :-1], image[1:, 1:]
    count = a.astype(np.int8) + b + c + d
    corners = []
    # Of one pixel that differs from the other three, and of two that touch at the corner: sides are those of the pixel.
    for pixel, opposite, right, lower in ((a, d, 0, 0), (b, c, 1, 0), (c, b, 0, 1), (d, a, 1, 1)):
        found = ((count == 1) & pixel) | ((count == 3) & ~pixel) | ((count == 2) & pixel & opposite)
        row, column = np.nonzero(found)
        corners.append((row, column, np.full_like(row, right), np.full_like(row, lower)))
    y, x, right, lower = (np.concatenate(part) for part in zip(*corners, strict=True))
    return y, x, right, lower


def _insert(polygon: Polygon, at: int, *parts: Polygon) -> Polygon:
    """Polygon with further vertices before index `at`."""
    points = (polygon.points[:at], *(part.points for part in parts), polygon.points[at:])
    inward = (polygon.inward[:at], *(part.inward for part in parts), polygon.inward[at:])
    return Polygon(np.concatenate(points), np.concatenate(inward))


def _cut_hole(parts: list[Polygon], hole: Polygon) -> None:
    """Join a hole to the part around it by a bridge to the left, through the upper pixel of its left side.

    Holes must come from left to right: what lies left of one is joined before (Eberly, Triangulation by Ear Clipping, 2002).
    """
    x, y = hole.points[np.lexsort((hole.points[:, 1], hole.points[:, 0]))[0]]
    middle = y + 0.5
    best, at, index = -np.inf, 0, 0
    for number, part in enumerate(parts):
        ends = np.roll(part.points, -1, axis=0)
        crossed = (part.points[:, 0] == ends[:, 0]) & ((part.points[:, 1] < middle) != (ends[:, 1] < middle)) & (ends[:, 0] < x)
        for side in np.flatnonzero(crossed):
            if ends[side, 0] > best:
                best, at, index = float(ends[side, 0]), int(side), number
    # The bridge's ends stand on vertical sides: they move inward along x alone.
    ours = _bridge_end(x, middle, -1)
    theirs = _bridge_end(best, middle, 1)
    start = int(np.flatnonzero((hole.points == (x, y)).all(axis=1))[0])
    before = start if _lies_below(hole, start) else start - 1
    ring = Polygon(np.roll(hole.points, -before - 1, axis=0), np.roll(hole.inward, -before - 1, axis=0))
    parts[index] = _insert(parts[index], at + 1, theirs, ours, ring, ours, theirs)


def _bridge_end(x: float, y: float, side: int) -> Polygon:
    """Polygon of one vertex, the end of a bridge; `side`: direction along x in which the mask lies."""
    return Polygon(np.array([[x, y]]), np.array([[side, 0]], np.int8))


def _lies_below(polygon: Polygon, corner: int) -> bool:
    """Whether the next vertex of a polygon lies straight below one."""
    here, there = polygon.points[corner], polygon.points[(corner + 1) % len(polygon.points)]
    return bool(here[0] == there[0] and there[1] > here[1])
