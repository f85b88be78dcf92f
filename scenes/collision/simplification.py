"""Convex hull simplification: few vertices, and planar facets whose normals differ by at least 4 degrees.

Scanned models have flat sides made of triangles whose normals differ by about a degree. Between two such sides, collision detection finds a
single contact point, which jumps from step to step, and resting objects jitter. An intersection of few half-spaces has exactly planar
sides, between which it finds several contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.types import ConvexPiece

# Smallest allowed `max_vertices`: a polyhedron of six facets has at most 8 vertices.
MIN_VERTICES = 8
# Maximum vertices of the intermediate, fine hull, whose triangles are clustered.
_FINE_VERTICES = 256
# Minimum volume that a further half-space cuts off, and that a further vertex of the fine hull adds, relative to the full hull's volume.
_MIN_GAIN, _FINE_GAIN = 1e-4, 1e-5
# Radius of a cluster of normals [rad]: 3 degrees. Newton's contact manifold samples the vertices of a facet in directions tilted by 2
# degrees from the contact normal, so that facets closer than this act as one.
_CLUSTER_ANGLE = np.radians(3.0)
# Minimum angle between the normals of two facets [rad].
_MIN_FACET_ANGLE = np.radians(4.0)
# The first six half-spaces face along the axes; a facet whose normal lies within this angle of an axis takes its place [rad]. Below 35
# degrees six such half-spaces always enclose a bounded polyhedron.
_FRAME_ANGLE = np.radians(30.0)
# The mean gap of a half-space is averaged over triangles whose normals lie within this angle of its own [rad].
_FIT_ANGLE = np.radians(20.0)
# Bisection steps of `_fit_volume`: the inward shift is found to 1/4096 of the mean gap.
_FIT_STEPS = 12
# Decimal places to which vertices are rounded [m], so that duplicates of a corner of an intersection become one vertex.
_DECIMALS = 8
# Maximum angle between the normals of coplanar triangles [rad].
_COPLANAR_ANGLE = 1e-3


@dataclass(frozen=True)
class _Facets:
    """Clusters of a hull's triangles as half-spaces n·x ≤ d, largest area first."""

    normal: np.ndarray
    """Outward unit normal n (facet, 3)."""
    offset: np.ndarray
    """Offset d of the supporting plane (facet) [m]."""
    gap: np.ndarray
    """Mean distance between the plane and the hull's triangles within _FIT_ANGLE, 0 if there are none (facet) [m]."""


def simplify_hull(points: np.ndarray, max_vertices: int) -> ConvexPiece:
    """Approximate the convex hull of points by an intersection of half-spaces, of the hull's volume if `max_vertices` allows it.

    A hull of no more vertices, whose facets already differ by _MIN_FACET_ANGLE, is kept. Otherwise its triangles are clustered by
    their normals, and each cluster gives a half-space. Those that cut off most are chosen greedily, up to `max_vertices`, and moved inward,
    by at most the mean gap between each and the hull, until the polyhedron has the hull's volume. With few vertices it stays larger, since
    six half-spaces near the axes come first: a sphere of 16 has 1.3 times the volume, of 8 twice as much, and a thin rod along a diagonal
    of 8 hundreds of times. Where the intersection fails, the hull of greedily selected points is returned, inside the full one.

    Args:
        points: (N, 3) [m].
        max_vertices: Maximum number of vertices, at least MIN_VERTICES.

    Raises:
        CatalogError: The points are coplanar.
        ValueError: `max_vertices` is below MIN_VERTICES.
    """
    if max_vertices < MIN_VERTICES:
        raise ValueError(f"max_vertices is {max_vertices}, but must be at least {MIN_VERTICES}")
    points = np.unique(points.astype(np.float32), axis=0).astype(np.float64)
    try:
        full = ConvexHull(points)
    except QhullError as error:
        raise CatalogError("all vertices lie in one plane; a body needs a volume") from error
    if len(full.vertices) <= max_vertices and _has_distinct_facets(full):
        return _to_piece(full)
    candidates = points[full.vertices]
    try:
        polyhedron = _choose_facets(_decimate(candidates, _FINE_VERTICES, _FINE_GAIN * full.volume), max_vertices, full.volume)
    except QhullError:
        # The inner point lies outside a half-space that was moved inward, or the points are too flat.
        return _to_piece(_decimate(candidates, max_vertices, _MIN_GAIN * full.volume))
    return _to_piece(polyhedron)


def _has_distinct_facets(hull: ConvexHull) -> bool:
    """Whether neighboring triangles of a hull are coplanar, or differ by _MIN_FACET_ANGLE."""
    normals = hull.equations[:, :3]
    angle = np.linalg.norm(normals[:, None] - normals[hull.neighbors], axis=2)
    return bool(((angle < _COPLANAR_ANGLE) | (angle > _MIN_FACET_ANGLE)).all())


def _choose_facets(hull: ConvexHull, max_vertices: int, volume: float) -> ConvexHull:
    """Greedy choice of half-spaces, whose intersection has at most `max_vertices`, and the given volume where that is possible."""
    center = hull.points[hull.vertices].mean(axis=0)
    facets, chosen = _cluster(hull)
    gains = np.full(len(facets.normal), np.inf)
    gains[chosen] = -1.0
    current = _intersect(facets, chosen, facets.offset, center)
    while (best := _best_facet(facets, chosen, gains, current, center)) is not None:
        index, polyhedron = best
        gains[index] = -1.0
        if len(polyhedron.vertices) > max_vertices:
            continue
        if current.volume - polyhedron.volume < _MIN_GAIN * volume:
            break
        chosen.append(index)
        current = polyhedron
    while len((fitted := _fit_volume(facets, chosen, volume, center)).vertices) > max_vertices:
        chosen.pop()
    return fitted


def _best_facet(
    facets: _Facets, chosen: list[int], gains: np.ndarray, current: ConvexHull, center: np.ndarray
) -> tuple[int, ConvexHull] | None:
    """The half-space with the largest gain, and the polyhedron with it; None if no candidate is left.

    A gain is the volume cut off times its height, so that spikes of little volume go, too. It only falls as others are cut off: lazy
    evaluation (Minoux, 1978) computes few of them anew.

    Args:
        gains: Upper bounds (facet), updated; negative for facets that are no candidates.
    """
    fresh: dict[int, ConvexHull] = {}
    while gains.max() >= 0.0:
        index = int(gains.argmax())
        if index in fresh:
            return index, fresh[index]
        fresh[index] = _intersect(facets, [*chosen, index], facets.offset, center)
        height = float((current.points @ facets.normal[index]).max() - facets.offset[index])
        gains[index] = max(0.0, current.volume - fresh[index].volume) * max(0.0, height)
    return None


def _fit_volume(facets: _Facets, chosen: Sequence[int], volume: float, center: np.ndarray) -> ConvexHull:
    """Move half-spaces inward, by a common fraction of their mean gaps, until the polyhedron has the given volume: bisection."""
    low, high = 0.0, 1.0
    for _ in range(_FIT_STEPS):
        middle = 0.5 * (low + high)
        larger = _intersect(facets, chosen, facets.offset - middle * facets.gap, center).volume > volume
        low, high = (middle, high) if larger else (low, middle)
    return _intersect(facets, chosen, facets.offset - low * facets.gap, center)


def _cluster(hull: ConvexHull) -> tuple[_Facets, list[int]]:
    """Cluster a hull's triangles by normals; returns the half-spaces, and the indices of six that enclose a bounded polyhedron."""
    corners, normals = hull.points[hull.simplices], hull.equations[:, :3]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
    near = normals @ normals.T > np.cos(_CLUSTER_ANGLE)
    free, means = np.ones(len(normals), bool), []
    while free.any():
        weight = np.where(free, near @ (area * free), -1.0)
        members = near[int(weight.argmax())] & free
        free &= ~members
        mean = area[members] @ normals[members]
        means.append((float(area[members].sum()), mean / np.linalg.norm(mean)))
    # Larger clusters first: those too near to one of them are left out, and the axes are replaced by facets where there are any.
    distinct: list[np.ndarray] = []
    for _, mean in sorted(means, key=lambda cluster: -cluster[0]):
        if all(mean @ other < np.cos(_MIN_FACET_ANGLE) for other in distinct):
            distinct.append(mean)
    frame: list[int] = []
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        aligned = [index for index, normal in enumerate(distinct) if normal @ axis > np.cos(_FRAME_ANGLE)]
        if not aligned:
            distinct.append(axis)
        frame.append(aligned[0] if aligned else len(distinct) - 1)
    normal = np.stack(distinct)
    offset = (normal @ hull.points[hull.vertices].T).max(axis=1)
    cosine = normals @ normal.T
    weight = np.where(cosine > np.cos(_FIT_ANGLE), area[:, None] * cosine, 0.0)
    mean_offset = np.einsum("tf,fi,ti->f", weight, normal, corners.mean(axis=1)) / np.maximum(weight.sum(axis=0), np.finfo(float).tiny)
    gap = np.where(weight.sum(axis=0) > 0.0, offset - mean_offset, 0.0)
    return _Facets(normal, offset, gap), list(dict.fromkeys(frame))


def _intersect(facets: _Facets, chosen: Sequence[int], offset: np.ndarray, center: np.ndarray) -> ConvexHull:
    """Hull of the vertices of an intersection of half-spaces with the given offsets (facet) around an inner point."""
    half_spaces = np.concatenate([facets.normal[chosen], -offset[chosen, None]], axis=1)
    vertices = HalfspaceIntersection(half_spaces, center).intersections
    return ConvexHull(np.unique(vertices.round(_DECIMALS), axis=0))


def _decimate(candidates: np.ndarray, max_vertices: int, min_gain: float) -> ConvexHull:
    """Greedy selection of points whose convex hull has nearly the volume of the full hull.

    Starting from `_extreme_points`, the point with the largest volume gain is added until there are `max_vertices`, or the gain falls
    below `min_gain` [m³]. The gain of a point p is the volume of the pyramids over the faces visible from it, Σ max(0, n·p + d) A / 3.
    """
    chosen = _extreme_points(candidates)
    hull = ConvexHull(candidates[chosen])
    while len(chosen) < max_vertices:
        corners = hull.points[hull.simplices]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
        gains = np.maximum(candidates @ hull.equations[:, :3].T + hull.equations[:, 3], 0.0) @ areas / 3.0
        best = int(gains.argmax())
        if gains[best] < min_gain or best in chosen:
            break
        chosen.append(best)
        hull = ConvexHull(candidates[chosen])
    return hull


def _extreme_points(points: np.ndarray) -> list[int]:
    """Initial vertices, at most six: indices of four points that span a tetrahedron, then of extreme points along the axes."""
    chosen = {int(index) for axis in range(3) for index in (points[:, axis].argmin(), points[:, axis].argmax())}
    first = points[min(chosen)]
    far = int(np.linalg.norm(points - first, axis=1).argmax())
    line = points[far] - first
    wide = int(np.linalg.norm(np.cross(points - first, line), axis=1).argmax())
    high = int(np.abs((points - first) @ np.cross(line, points[wide] - first)).argmax())
    spanning = [min(chosen), far, wide, high]
    # The four span a tetrahedron; the extreme points along the axes alone may be coplanar.
    return list(dict.fromkeys([*spanning, *sorted(chosen)]))[:6]


def _to_piece(hull: ConvexHull) -> ConvexPiece:
    """The hull's vertices and triangles. Outward orientation spreads over shared edges: normals of thin triangles are unreliable."""
    faces = hull.simplices.copy()
    corners = hull.points[faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    start = int(np.linalg.norm(doubled, axis=1).argmax())
    if doubled[start] @ hull.equations[start, :3] < 0.0:
        faces[start] = faces[start, ::-1]
    oriented, waiting = {start}, [start]
    while waiting:
        face = waiting.pop()
        edges = {(int(faces[face, k]), int(faces[face, (k + 1) % 3])) for k in range(3)}
        for neighbor in (int(n) for n in hull.neighbors[face]):
            if neighbor in oriented:
                continue
            if any((int(faces[neighbor, k]), int(faces[neighbor, (k + 1) % 3])) in edges for k in range(3)):
                faces[neighbor] = faces[neighbor, ::-1]
            oriented.add(neighbor)
            waiting.append(neighbor)
    used, index = np.unique(faces, return_inverse=True)
    return ConvexPiece(hull.points[used].astype(np.float32), index.reshape(-1, 3).astype(np.int32))
