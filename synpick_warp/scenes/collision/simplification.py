"""Convex hull simplification: few vertices, and planar facets whose normals differ by at least 4 degrees.

Scanned models have flat sides made of triangles whose normals differ by about a degree. Between two such sides, collision detection finds a
single contact point, which jumps from step to step, and resting objects jitter. An intersection of few half-spaces has sides that are
planar up to rounding, between which it finds several contacts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog, root_scalar
from scipy.spatial import ConvexHull, HalfspaceIntersection, KDTree, QhullError
from trimesh import Trimesh
from trimesh.repair import fix_normals

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.types import ConvexPiece
from synpick_warp.system.linear_algebra import DECIMALS, det, dot, eigh, matmul, norm

# Smallest allowed `max_vertices`: a polyhedron of six facets has at most 8 vertices.
MIN_VERTICES = 8
# Maximum vertices of the fine hull, an intermediate result whose triangles are clustered.
_FINE_VERTICES = 256
# Decimation ends when no vertex adds at least this volume, relative to the full hull's: for the fine hull, and for the fallback.
_FINE_GAIN, _COARSE_GAIN = 1e-5, 1e-4
# Minimum `_gain` of a half-space, for a full hull of unit volume and unit radius: that of a half-space that cuts off 0.01 % of the volume
# at a height of 1 % of the radius.
_MIN_GAIN = 1e-4 * 0.01**1.25


def _cosine(degrees: float) -> float:
    """Cosine of an angle between normals, rounded as DECIMALS asks."""
    return round(float(np.cos(np.radians(degrees))), DECIMALS)


# Radius of a cluster of normals: 3 degrees. The physics engine's contact manifold samples the vertices of a facet in directions
# tilted by 2 degrees from the contact normal, so that it treats facets at a smaller angle as one.
_CLUSTER_COSINE = _cosine(3.0)
# Minimum angle between the normals of two facets: 4 degrees.
_FACET_COSINE = _cosine(4.0)
# The selection starts from the six sides of an oriented box. A facet whose normal lies within this angle of a side's normal replaces the
# side; below 35 degrees, the six half-spaces always enclose a bounded polyhedron.
_FRAME_COSINE = _cosine(30.0)
# Area assigned to a principal axis in the choice of the box's second axis, relative to the largest facet's: smaller than that of any facet
# that should be preferred.
_PRINCIPAL_WEIGHT = 1e-3
# The mean gap of a half-space is averaged over triangles whose normals lie within 20 degrees of its own.
_FIT_COSINE = _cosine(20.0)
# Extra half-spaces selected before backward elimination. Both values are tried, and the smaller polyhedron is kept: that of round discs is
# smaller with 0, that of rounded tetrahedra with 6, since every side of the box can then be replaced.
_SPARE = (0, 6)
# Tolerance of the root finding in `_fit_volume`, in mean gaps; scaling removes what is left.
_FIT_TOLERANCE = 1e-3
# Decimal places to which vertices of an intersection are rounded [standard deviations], so that duplicates become one vertex.
_DECIMALS = 11
# Distance below which one of two vertices of a result is left out, relative to the largest coordinate: 16 times the rounding to single
# precision.
_WELD = 1e-6
# Minimum radius of the inscribed ball of an intersection that is not empty [standard deviations].
_EMPTY = 1e-9
# An intersection with a vertex farther than this from the inner point counts as unbounded [standard deviations].
_FAR = 1e4
# Minimum cosine between the normals of coplanar triangles: 1e-3 rad.
_COPLANAR_COSINE = 1.0 - 1e-6 / 2.0


@dataclass(frozen=True)
class _Facets:
    """Half-spaces n·x ≤ d relative to a hull's centroid, with the mean gap to its surface: those of clusters of its triangles, largest area
    first, then sides of a box along the principal axes."""

    normal: np.ndarray
    """Outward unit normal n (facet, 3)."""
    offset: np.ndarray
    """Offset d of the supporting plane (facet)."""
    gap: np.ndarray
    """Mean distance between the plane and the hull's triangles within _FIT_COSINE, 0 if there are none (facet)."""
    axes: np.ndarray
    """Principal axes of the hull's vertices in columns, each as long as their standard deviation along it (3, 3)."""


def simplify_hull(points: np.ndarray, max_vertices: int) -> ConvexPiece:
    """Approximate the convex hull of points by an intersection of half-spaces, of the hull's volume.

    A hull of no more vertices, whose facets already differ by 4 degrees, is kept. Otherwise its triangles are clustered by their normals,
    and each cluster gives a half-space. Those that cut off most are selected greedily, and moved inward, by at most the mean gap between
    each and the hull, until the polyhedron has the hull's volume. Last, the polyhedron is scaled about its centroid to exactly this volume,
    by little unless `max_vertices` is small; this also moves flat sides. Turned points give a turned result, except for the half-spaces of
    the smallest gain: the threshold is relative to the axis-aligned bounding box. If Qhull fails on the half-spaces, which no hull thicker
    than a millionth of its diameter has shown, the result is the hull of greedily selected points, with less volume.

    Args:
        points: (N, 3) [m].
        max_vertices: Maximum number of vertices, at least MIN_VERTICES.

    Raises CatalogError: the points are coplanar, or nearly so; ValueError: `max_vertices` is below MIN_VERTICES."""
    if max_vertices < MIN_VERTICES:
        raise ValueError(f"max_vertices is {max_vertices}, but must be at least {MIN_VERTICES}")
    points = np.unique(points.astype(np.float32), axis=0).astype(np.float64)
    # The unit of length of all that follows, "radius": half the diagonal of the bounding box.
    low, high = points.min(axis=0), points.max(axis=0)
    middle, radius = (low + high) / 2.0, max(float(norm(high - low)) / 2.0, float(np.finfo(np.float32).tiny))
    full = _hull_of((points - middle) / radius)
    if len(full.vertices) <= max_vertices and _has_distinct_facets(full):
        return hull_piece(points[full.vertices])
    candidates = full.points[full.vertices]
    try:
        vertices = _choose_facets(_decimate(candidates, _FINE_VERTICES, _FINE_GAIN * full.volume), max_vertices, full.volume)
    except QhullError:
        hull = _decimate(candidates, max_vertices, _COARSE_GAIN * full.volume)
        vertices = hull.points[hull.vertices]
    return hull_piece(vertices * radius + middle)


def _hull_of(points: np.ndarray) -> ConvexHull:
    """Convex hull of points (N, 3). Raises CatalogError: the points are coplanar."""
    try:
        return ConvexHull(points)
    except QhullError as error:
        raise CatalogError("all vertices lie in one plane; a body needs a volume") from error


def _has_distinct_facets(hull: ConvexHull) -> bool:
    """Whether neighboring triangles of a hull are coplanar, or differ by 4 degrees."""
    normals = hull.equations[:, :3]
    cosine = dot(normals[:, None], normals[hull.neighbors])
    return bool(((cosine > _COPLANAR_COSINE) | (cosine < _FACET_COSINE)).all())


def _centroid(hull: ConvexHull) -> np.ndarray:
    """Centroid of a hull: mean of the tetrahedra between its triangles and an inner point, weighted by volume."""
    inner = hull.points[hull.vertices].mean(axis=0)
    corners = hull.points[hull.simplices] - inner
    volume = np.abs(det(corners))
    return inner + dot(corners.sum(axis=1).T, volume) / (4.0 * volume.sum())


def _choose_facets(hull: ConvexHull, max_vertices: int, volume: float) -> np.ndarray:
    """Forward-backward greedy selection of half-spaces; vertices of their intersection, at most `max_vertices`, of the given volume."""
    center = _centroid(hull)
    facets, chosen = _cluster(hull, center)
    # A polyhedron of F facets has at most 2 F - 4 vertices (Euler), wherever its half-spaces are moved.
    max_facets = (max_vertices + 4) // 2
    chosen = _select(facets, chosen, max_facets + max(_SPARE), _MIN_GAIN * volume)
    starts = dict.fromkeys(tuple(chosen[: max_facets + spare]) for spare in _SPARE)  # One, if the selection ended before the first limit.
    choices = [_eliminate(facets, start, max_facets, _MIN_GAIN * volume) for start in starts]
    best = min(choices, key=lambda choice: choice[1].volume)
    return center + _fit_volume(facets, *best, volume)


def _gain(larger: ConvexHull, smaller: ConvexHull, normal: np.ndarray, offset: float) -> float:
    """Gain of a half-space that reduces one polyhedron to another: the volume it cuts off, times the height of what it cuts off to the 5/4,
    so that it also removes spikes of little volume.

    With an exponent of 1, pieces of the YCB-Video objects reach up to 4.8 mm beyond the full hulls; with 1.25 4.2 mm.
    """
    height = max(0.0, float(dot(larger.points, normal).max() - offset))
    return max(0.0, larger.volume - smaller.volume) * height * math.sqrt(math.sqrt(height))


def _select(facets: _Facets, chosen: list[int], max_facets: int, min_gain: float) -> list[int]:
    """Forward selection: add the half-space with the largest gain until there are `max_facets`, or none gains `min_gain`.

    A gain only falls as others are cut off: lazy evaluation (Minoux, 1978) computes few of them anew.
    """
    chosen, current = list(chosen), _intersect(facets, chosen)
    gains = np.full(len(facets.normal), np.inf)
    gains[chosen] = -1.0
    fresh: dict[int, ConvexHull] = {}
    while len(chosen) < max_facets and gains.max() >= min_gain:
        index = int(gains.argmax())
        if index in fresh:
            chosen.append(index)
            gains[index], current, fresh = -1.0, fresh[index], {}
            continue
        fresh[index] = _intersect(facets, [*chosen, index])
        gains[index] = _gain(current, fresh[index], facets.normal[index], facets.offset[index])
    return chosen


def _eliminate(facets: _Facets, chosen: Sequence[int], max_facets: int, min_gain: float) -> tuple[list[int], ConvexHull]:
    """Backward elimination: remove the half-space with the least gain beside the others while there are more than `max_facets`, or it gains
    less than `min_gain`.

    A gain only grows as others are removed, hence lazy evaluation again. Of more than six half-spaces one can always be removed so that the
    intersection stays bounded (Steinitz).
    """
    chosen = list(chosen)
    current = _intersect(facets, chosen)
    gains = np.full(len(facets.normal), np.inf)
    gains[chosen] = 0.0
    fresh: dict[int, ConvexHull] = {}
    while gains.min() < (np.inf if len(chosen) > max_facets else min_gain):
        index = int(gains.argmin())
        others = [other for other in chosen if other != index]
        if index in fresh:
            gains[index], chosen, current, fresh = np.inf, others, fresh[index], {}
            continue
        try:
            fresh[index] = _intersect(facets, others)
        except QhullError:  # unbounded
            gains[index] = np.inf
            continue
        gains[index] = _gain(fresh[index], current, facets.normal[index], facets.offset[index])
    if len(chosen) > max_facets:
        raise QhullError("an intersection of fewer half-spaces could not be computed")
    return chosen, current


def _fit_volume(facets: _Facets, chosen: Sequence[int], polyhedron: ConvexHull, volume: float) -> np.ndarray:
    """Vertices of the intersection, given as a `polyhedron`, whose half-spaces are moved inward, by a common fraction of their mean gaps,
    to the given volume.

    The cube root of the volume is concave in the shift (Brunn-Minkowski), which suits root finding. Scaling does the rest.
    """
    moved: dict[float, ConvexHull | None] = {0.0: polyhedron}

    def excess(shift: float) -> float:
        """Difference of the cube roots of the volumes of the shifted and of the wanted polyhedron [m]."""
        if shift not in moved:
            try:
                moved[shift] = _intersect(facets, chosen, shift)
            except QhullError:  # moved so far that it is empty
                moved[shift] = None
        hull = moved[shift]
        return (0.0 if hull is None else _cube_root(hull.volume)) - _cube_root(volume)

    if excess(0.0) <= 0.0:
        shift = 0.0
    elif excess(1.0) >= 0.0:
        shift = 1.0
    else:
        shift = root_scalar(excess, method="brentq", bracket=(0.0, 1.0), xtol=_FIT_TOLERANCE).root
    polyhedron = moved.get(shift) or _intersect(facets, chosen, shift)
    center = _centroid(polyhedron)
    return center + (polyhedron.points[polyhedron.vertices] - center) * _cube_root(volume / polyhedron.volume)


def _cube_root(value: float) -> float:
    """Cube root, rounded as DECIMALS asks."""
    return round(float(np.cbrt(value)), DECIMALS)


def _cluster(hull: ConvexHull, center: np.ndarray) -> tuple[_Facets, list[int]]:
    """Cluster a hull's triangles by normals; returns the half-spaces, and the indices of six that enclose a bounded polyhedron."""
    corners, normals = hull.points[hull.simplices] - center, hull.equations[:, :3]
    area = norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])) / 2.0
    near = matmul(normals, normals.T) > _CLUSTER_COSINE
    free, means = np.ones(len(normals), bool), []
    while free.any():
        weight = np.where(free, np.where(near, area * free, 0.0).sum(axis=1), -1.0)
        members = near[int(weight.argmax())] & free
        free &= ~members
        mean = (area[members, None] * normals[members]).sum(axis=0)
        means.append((float(area[members].sum()), mean / norm(mean)))
    # Larger clusters first: those too near to one of them are left out.
    distinct: list[tuple[float, np.ndarray]] = []
    for size, mean in sorted(means, key=lambda cluster: -cluster[0]):
        if all(dot(mean, other) < _FACET_COSINE for _, other in distinct):
            distinct.append((size, mean))
    axes = _principal_axes(hull.points[hull.vertices])
    normal, frame = _add_frame(np.array([size for size, _ in distinct]), np.stack([mean for _, mean in distinct]), axes)
    offset = matmul(normal, (hull.points[hull.vertices] - center).T).max(axis=1)
    cosine = matmul(normals, normal.T)
    weight = np.where(cosine > _FIT_COSINE, area[:, None] * cosine, 0.0)
    mean_offset = np.einsum("tf,fi,ti->f", weight, normal, corners.mean(axis=1)) / np.maximum(weight.sum(axis=0), np.finfo(float).tiny)
    gap = np.where(weight.sum(axis=0) > 0.0, offset - mean_offset, 0.0)
    return _Facets(normal, offset, gap, axes), frame


def _principal_axes(points: np.ndarray) -> np.ndarray:
    """Principal axes of points (N, 3) in columns, each as long as the standard deviation along it (3, 3)."""
    offsets = points - points.mean(axis=0)
    variances, axes = eigh(matmul(offsets.T, offsets) / len(points))
    return axes[:, ::-1] * np.sqrt(variances[::-1])


def _add_frame(area: np.ndarray, normal: np.ndarray, principal: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Add the sides of an enclosing box to normals (facet, 3), where no facet is near; returns all, and the indices of the six.

    The first axis of the box is the normal of the largest facet. The second one is the perpendicular part of the normal that maximizes area
    times sine of the angle to the first; principal axes (3, 3) compete with a small area, and win where all other facets are tiny.
    """
    first = normal[int(area.argmax())]
    vectors = np.concatenate([normal, (principal / norm(principal.T)).T])
    across = vectors - np.outer(dot(vectors, first), first)
    weight = np.append(area, np.full(3, _PRINCIPAL_WEIGHT * area.max()))
    second = across[int((weight * norm(across)).argmax())]
    second = second / norm(second)
    axes = np.stack([first, second, np.cross(first, second)])
    frame, added = [], []
    for axis in np.concatenate([axes, -axes]):
        score = area * (dot(normal, axis) - _FRAME_COSINE)
        if score.max() > 0.0:
            frame.append(int(score.argmax()))
        else:
            frame.append(len(normal) + len(added))
            added.append(axis)
    return np.concatenate([normal, np.reshape(added, (-1, 3))]), list(dict.fromkeys(frame))


def _intersect(facets: _Facets, chosen: Sequence[int], shift: float = 0.0) -> ConvexHull:
    """Hull of the vertices of an intersection of half-spaces, each moved inward by `shift` gaps.

    Computed in coordinates along the principal axes, in standard deviations: for flat hulls Qhull would merge dual points otherwise. Raises
    QhullError: it is empty or unbounded."""
    normal, offset = matmul(facets.normal[chosen], facets.axes), facets.offset[chosen] - shift * facets.gap[chosen]
    length = norm(normal)
    normal, offset = normal / length[:, None], offset / length
    # The centroid lies inside of the supporting planes, but not of all planes that were moved inward.
    inner = np.zeros(3) if shift == 0.0 else _chebyshev_center(normal, offset)
    with np.errstate(divide="ignore", invalid="ignore"):  # A facet of the dual hull through the inner point is a vertex at infinity.
        intersection = HalfspaceIntersection(np.column_stack([normal, -offset]), inner)
    # A facet of the dual hull at distance b from the inner point is a vertex at distance 1/b from it.
    if intersection.dual_equations[:, 3].max() > -1.0 / _FAR:
        raise QhullError("the intersection is unbounded")
    vertices = intersection.intersections.round(_DECIMALS) + 0.0  # without negative zeros
    vertices = vertices[np.lexsort(vertices.T[::-1])]
    vertices = vertices[np.append(True, (vertices[1:] != vertices[:-1]).any(axis=1))]
    return ConvexHull(matmul(vertices, facets.axes.T))


def _chebyshev_center(normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Chebyshev center: the center of the largest ball inside an intersection of half-spaces, by linear programming. Raises QhullError: the
    intersection is empty."""
    constraints = np.column_stack([normal, np.ones(len(normal))])
    result = linprog((0.0, 0.0, 0.0, -1.0), constraints, offset, bounds=[(None, None)] * 3 + [(0.0, None)])
    if not result.success or result.x[3] < _EMPTY:
        raise QhullError("the intersection is empty")
    return result.x[:3]


def _decimate(candidates: np.ndarray, max_vertices: int, min_gain: float) -> ConvexHull:
    """Greedy selection of points whose convex hull has nearly the volume of the full hull.

    Starting from `_spanning_points`, the point with the largest volume gain is added until there are `max_vertices`, or the gain falls
    below `min_gain`, in the points' unit cubed. The gain of a point p is the volume of the pyramids over the faces visible from it, Σ
    max(0, n·p + d) A / 3.
    """
    chosen = _spanning_points(candidates)
    hull = _hull_of(candidates[chosen])
    while len(chosen) < max_vertices:
        corners = hull.points[hull.simplices]
        areas = norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])) / 2.0
        gains = dot(np.maximum(matmul(candidates, hull.equations[:, :3].T) + hull.equations[:, 3], 0.0), areas) / 3.0
        best = int(gains.argmax())
        if gains[best] < min_gain or best in chosen:
            break
        chosen.append(best)
        hull = _hull_of(candidates[chosen])
    return hull


def _spanning_points(points: np.ndarray) -> list[int]:
    """Indices of four points that span a tetrahedron: each the farthest from the mean, from the first point, the line, the plane so far."""
    start = int(norm(points - points.mean(axis=0)).argmax())
    far = int(norm(points - points[start]).argmax())
    line = points[far] - points[start]
    wide = int(norm(np.cross(points - points[start], line)).argmax())
    high = int(np.abs(dot(points - points[start], np.cross(line, points[wide] - points[start]))).argmax())
    return [start, far, wide, high]


def hull_piece(points: np.ndarray) -> ConvexPiece:
    """Vertices and triangles of the hull of points in single precision, of which near ones are welded.

    Outward orientation spreads over shared edges: normals of thin triangles are unreliable.
    """
    points = points.astype(np.float32).astype(np.float64)
    near = KDTree(points).query_pairs(_WELD * np.abs(points).max(), output_type="ndarray")
    hull = _hull_of(np.delete(points, near[:, 1], axis=0))
    mesh = Trimesh(hull.points, hull.simplices, process=False)
    fix_normals(mesh)
    used, index = np.unique(mesh.faces, return_inverse=True)
    return ConvexPiece(hull.points[used].astype(np.float32), index.reshape(-1, 3).astype(np.int32))
