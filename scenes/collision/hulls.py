"""Convex hulls of few vertices, and what convex bodies weigh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.types import ConvexPiece

# A hull does not take a vertex that adds less than this share of its volume.
_LEAST_GAIN = 1e-4
# A hull is flat if it fills less than this share of the cube over its extent: 0.2 µm on a sheet of 0.2 m.
_FLAT = 1e-6


@dataclass(frozen=True)
class MassProperties:
    """Of uniform density."""

    volume: float
    """[m³]"""
    center_of_mass: np.ndarray
    """(3) float64 [m]"""
    unit_inertia: np.ndarray
    """About the centre of mass, for 1 kg (3, 3) float64 [m²]."""


def hull_volume(points: np.ndarray) -> float:
    """Volume of the convex hull of points (N, 3) [m³]; 0 if they lie in a plane."""
    try:
        hull = ConvexHull(points.astype(np.float64))
    except QhullError:
        return 0.0
    return float(hull.volume) if hull.volume > _FLAT * np.ptp(points, axis=0).max() ** 3 else 0.0


def limited_hull(points: np.ndarray, limit: int) -> ConvexPiece:
    """Convex hull of at most `limit` of the points, chosen one by one so that each adds the most volume.

    What a point adds is exact: the pyramids over the triangles it sees, V = Σ max(0, n·p + d) A / 3.

    Args:
        points: (N, 3) [m].
        limit: Most vertices, at least 6.

    Raises:
        CatalogError: The points lie in a plane.
    """
    points = np.unique(points.astype(np.float32), axis=0).astype(np.float64)
    try:
        whole = ConvexHull(points)
    except QhullError as error:
        raise CatalogError("all vertices lie in one plane; a body needs a volume") from error
    candidates = points[whole.vertices]
    chosen = _extreme_points(candidates)
    hull = ConvexHull(candidates[chosen])
    while len(chosen) < limit:
        corners = hull.points[hull.simplices]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
        gains = np.maximum(candidates @ hull.equations[:, :3].T + hull.equations[:, 3], 0.0) @ areas / 3.0
        best = int(gains.argmax())
        if gains[best] < _LEAST_GAIN * whole.volume or best in chosen:
            break
        chosen.append(best)
        hull = ConvexHull(candidates[chosen])
    return _piece(hull)


def _extreme_points(points: np.ndarray) -> list[int]:
    """Indices of four to six points that span a volume: the outermost along each axis, then those that add most."""
    chosen = {int(index) for axis in range(3) for index in (points[:, axis].argmin(), points[:, axis].argmax())}
    first = points[min(chosen)]
    far = int(np.linalg.norm(points - first, axis=1).argmax())
    line = points[far] - first
    wide = int(np.linalg.norm(np.cross(points - first, line), axis=1).argmax())
    high = int(np.abs((points - first) @ np.cross(line, points[wide] - first)).argmax())
    spanning = [min(chosen), far, wide, high]
    # The four span a tetrahedron for sure; the axes' extremes alone may not.
    return list(dict.fromkeys([*spanning, *sorted(chosen)]))[:6]


def _piece(hull: ConvexHull) -> ConvexPiece:
    """The hull's vertices and its triangles, turned outward along shared edges: thin triangles have no normal to go by."""
    faces = hull.simplices.copy()
    corners = hull.points[faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    start = int(np.linalg.norm(doubled, axis=1).argmax())
    if doubled[start] @ hull.equations[start, :3] < 0.0:
        faces[start] = faces[start, ::-1]
    done, waiting = {start}, [start]
    while waiting:
        face = waiting.pop()
        edges = {(int(faces[face, k]), int(faces[face, (k + 1) % 3])) for k in range(3)}
        for neighbor in (int(n) for n in hull.neighbors[face]):
            if neighbor in done:
                continue
            if any((int(faces[neighbor, k]), int(faces[neighbor, (k + 1) % 3])) in edges for k in range(3)):
                faces[neighbor] = faces[neighbor, ::-1]
            done.add(neighbor)
            waiting.append(neighbor)
    used, index = np.unique(faces, return_inverse=True)
    return ConvexPiece(hull.points[used].astype(np.float32), index.reshape(-1, 3).astype(np.int32))


def mass_properties(pieces: Sequence[ConvexPiece]) -> MassProperties:
    """Volume, centre of mass and inertia of the pieces' sum; where pieces overlap, the overlap counts twice.

    Exact for polyhedra: sums over the tetrahedra of each triangle with a point inside. For one with edges a, b, c from that point,
    V = a·(b x c)/6, ∫x = V s/4, ∫xxᵀ = V (aaᵀ + bbᵀ + ccᵀ + ssᵀ)/20, s = a + b + c; inertia = tr(C) 1 - C of the second moment C.
    So its eigenvalues keep the triangle inequality as long as C has no negative ones.
    """
    origin = np.concatenate([piece.vertices for piece in pieces]).mean(axis=0, dtype=np.float64)
    corners = np.concatenate([(piece.vertices - origin)[piece.faces] for piece in pieces])
    volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    sums = corners.sum(axis=1)
    volume = volumes.sum()
    center = volumes @ sums / (4.0 * volume)
    second = np.einsum("f,fki,fkj->ij", volumes, corners, corners) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    spread = second / (20.0 * volume) - np.outer(center, center)
    spread = (spread + spread.T) / 2.0
    return MassProperties(float(volume), origin + center, np.trace(spread) * np.eye(3) - spread)
