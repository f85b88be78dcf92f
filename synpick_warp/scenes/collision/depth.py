"""Depth of a convex hull above the surface of its mesh, which says whether the hull may stand for the mesh in collisions."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, KDTree, QhullError
from trimesh.triangles import closest_point

from synpick_warp.scenes.assets.meshes import merge_positions, signed_volume
from synpick_warp.system.linear_algebra import matmul

# Points of the hull whose distance is measured, points of the surface by which the nearest triangles are found, and how many of these.
_POINTS, _DENSE, _NEAREST = 10_000, 60_000, 8
# Directions in which the thickness of a hull is measured, at most: those of its facets.
_DIRECTIONS = 1_000
# Digits of the result: an object is not concave on one machine and convex on another for a last bit.
_DIGITS = 4


# Part of the hull's volume from which a body counts as convex.
_FULL = 0.99


def is_concave(vertices: np.ndarray, faces: np.ndarray, hull_volume: float, ratio: float) -> bool:
    """Whether the hull of a mesh is too deep above its surface to stand for it: 1 - `relative_depth` is below `ratio`.

    What fills its hull but for 1 % is not measured.
    """
    return signed_volume(vertices, faces) < _FULL * hull_volume and 1.0 - relative_depth(vertices, faces) < ratio


def relative_depth(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Depth of the convex hull above the surface (directed Hausdorff distance), by half of the hull's thickness (its least width).

    0 of convex and of hollow bodies; 0.8 of a tube whose wall is a tenth of its diameter; 1 and more of a bowl, of a bracket, and of a
    plate with holes as wide as it is thick. Measured from samples of the hull to the triangles nearby.

    Args:
        vertices: (V, 3).
        faces: (F, 3).

    Returns:
        The ratio; 0 of coplanar points.
    """
    positions, faces = merge_positions(vertices.astype(np.float64), faces)
    try:
        hull = ConvexHull(positions)
    except QhullError:
        return 0.0
    corners, areas = _triangles(positions, faces)
    rows, dense = _sample(corners, areas, _DENSE)
    # Centroids as well: small triangles may have no sample.
    middles = np.arange(0, len(corners), -(-len(corners) // _DENSE))
    tree = KDTree(np.concatenate([dense, corners[middles].mean(axis=1)]))
    _, points = _sample(*_triangles(positions, hull.simplices), _POINTS)
    near = np.concatenate([rows, middles])[tree.query(points, _NEAREST)[1]].reshape(-1)
    repeated = np.repeat(points, _NEAREST, axis=0)
    distance = np.linalg.norm(closest_point(corners[near], repeated) - repeated, axis=1).reshape(-1, _NEAREST).min(axis=1)
    normals = hull.equations[:: -(-len(hull.equations) // _DIRECTIONS), :3]
    thickness = np.ptp(matmul(positions[hull.vertices], normals.T), axis=0).min()
    return round(2.0 * float(distance.max()) / float(thickness), _DIGITS)


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Points (count, 3) that lie evenly on a surface, the same for the same surface."""
    return _sample(*_triangles(vertices.astype(np.float64), faces), count)[1]


def _triangles(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (F, 3, 3) and doubled areas (F) of the triangles that have an area."""
    corners = positions[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners[areas > 0.0], areas[areas > 0.0]


def _sample(corners: np.ndarray, areas: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangle (count) and position (count, 3) of points as `sample_surface` has."""
    rows = np.searchsorted(np.cumsum(areas), (np.arange(count) + 0.5) * areas.sum() / count).clip(max=len(areas) - 1)
    first, second = np.random.default_rng(0).random((2, count, 1))
    first = np.sqrt(first)
    a, b, c = np.moveaxis(corners[rows], 1, 0)
    return rows, (1.0 - first) * a + first * ((1.0 - second) * b + second * c)
