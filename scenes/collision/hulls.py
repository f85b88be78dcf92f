"""Convex hulls: size and simplification; mass properties of convex polyhedra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.types import ConvexPiece, HullSize

# Smallest volume that another vertex must add, as a fraction of the full hull's.
_MIN_GAIN = 1e-4
# Points count as coplanar if their hull fills less than this fraction of the cube of their extent: 0.2 µm on a sheet of 0.2 m.
_FLAT = 1e-6
# Rows of the distance matrix that are computed at a time: fine round meshes have tens of thousands of hull vertices.
_DISTANCE_ROWS = 1024


@dataclass(frozen=True)
class MassProperties:
    """Volume, centre of mass and inertia tensor of a body of uniform density."""

    volume: float
    """[m³]"""
    center_of_mass: np.ndarray
    """(3) float64 [m]"""
    unit_inertia: np.ndarray
    """Inertia tensor about the centre of mass per mass (3, 3) float64 [m²]."""


def hull_size(points: np.ndarray) -> HullSize:
    """Compute volume and diameter of the convex hull of points (N, 3) [m]; both are 0 for degenerate points."""
    hull = _hull_of(points)
    if hull is None:
        return HullSize(0.0, 0.0)
    corners = hull.points[hull.vertices]
    blocks = (corners[start : start + _DISTANCE_ROWS] for start in range(0, len(corners), _DISTANCE_ROWS))
    return HullSize(float(hull.volume), max(float(cdist(block, corners).max()) for block in blocks))


def hull_volume(points: np.ndarray) -> float:
    """Compute the volume of the convex hull of points (N, 3) [m³]; 0 for degenerate points."""
    hull = _hull_of(points)
    return 0.0 if hull is None else float(hull.volume)


def _hull_of(points: np.ndarray) -> ConvexHull | None:
    """Compute the convex hull of points (N, 3) in float64; None for degenerate points: coplanar ones, by `_FLAT` or Qhull."""
    try:
        hull = ConvexHull(points.astype(np.float64))
    except QhullError:
        return None
    return hull if hull.volume > _FLAT * np.ptp(points, axis=0).max() ** 3 else None


def simplify_hull(points: np.ndarray, max_vertices: int) -> ConvexPiece:
    """Greedy convex hull simplification: select points whose convex hull has nearly the volume of the full hull.

    Starting from `_extreme_points`, the point with the largest volume gain is added until there are `max_vertices`, or the gain falls
    below `_MIN_GAIN`. The gain of a point p is the volume of the pyramids over the faces visible from it, Σ max(0, n·p + d) A / 3.

    Args:
        points: (N, 3) [m].
        max_vertices: Maximum number of vertices, at least 6.

    Raises:
        CatalogError: The points are coplanar.
    """
    points = np.unique(points.astype(np.float32), axis=0).astype(np.float64)
    try:
        full = ConvexHull(points)
    except QhullError as error:
        raise CatalogError("all vertices lie in one plane; a body needs a volume") from error
    candidates = points[full.vertices]
    chosen = _extreme_points(candidates)
    hull = ConvexHull(candidates[chosen])
    while len(chosen) < max_vertices:
        corners = hull.points[hull.simplices]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
        gains = np.maximum(candidates @ hull.equations[:, :3].T + hull.equations[:, 3], 0.0) @ areas / 3.0
        best = int(gains.argmax())
        if gains[best] < _MIN_GAIN * full.volume or best in chosen:
            break
        chosen.append(best)
        hull = ConvexHull(candidates[chosen])
    return _to_piece(hull)


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


def mass_properties(pieces: Sequence[ConvexPiece]) -> MassProperties:
    """Mass properties of the union of convex pieces at uniform density; where pieces overlap, the overlap counts twice.

    Exact for polyhedra, as a sum over signed tetrahedra between each triangle and an inner point. With edges a, b, c from that
    point and s = a + b + c: V = a·(b x c)/6, ∫x = V s/4, ∫xxᵀ = V (aaᵀ + bbᵀ + ccᵀ + ssᵀ)/20. Inertia = tr(C) 1 - C, where C is
    the covariance (second moment); its eigenvalues satisfy the triangle inequality as long as C is positive semidefinite.
    """
    origin = np.concatenate([piece.vertices for piece in pieces]).mean(axis=0, dtype=np.float64)
    corners = np.concatenate([(piece.vertices - origin)[piece.faces] for piece in pieces])
    volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    sums = corners.sum(axis=1)
    volume = volumes.sum()
    center = volumes @ sums / (4.0 * volume)
    second = np.einsum("f,fki,fkj->ij", volumes, corners, corners) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    covariance = second / (20.0 * volume) - np.outer(center, center)
    covariance = (covariance + covariance.T) / 2.0
    return MassProperties(float(volume), origin + center, np.trace(covariance) * np.eye(3) - covariance)
