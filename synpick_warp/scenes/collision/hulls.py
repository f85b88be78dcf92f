"""Convex hulls: volume and diameter; depth above the surface of their mesh, which says whether a hull may stand for it in collisions; mass
properties and half-spaces (H-representation) of convex polyhedra."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, KDTree, QhullError
from scipy.spatial.distance import cdist
from trimesh.triangles import closest_point

from synpick_warp.scenes.assets.meshes import merge_positions, signed_volume
from synpick_warp.scenes.types import Catalog, ConvexPiece, HullSize
from synpick_warp.system.linear_algebra import dot, matmul

# Points count as coplanar if their hull fills less than this fraction of the cube of their extent: 0.2 µm on a sheet of 0.2 m.
_FLAT = 1e-6
# Entries of the distance matrix that are computed at a time.
_DISTANCES = 2**24
# Most hull vertices whose pairs are all compared, which takes some seconds; fine round meshes have hundreds of thousands.
_MOST_COMPARED = 2**15
# Number of vertices from which the farthest-point search in larger hulls starts.
_STARTS = 1024
# Coplanar triangles are merged into one half-space if normal and offset [m] agree to this many decimals. Vertices in single precision tilt
# the triangles of a facet against each other by up to 1e-6.
_DECIMALS = 5


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
    return HullSize(float(hull.volume), _largest_distance(hull.points[hull.vertices]))


def _largest_distance(corners: np.ndarray) -> float:
    """Diameter of a point set, the vertices (N, 3) of a hull: exact, over all pairs, for up to `_MOST_COMPARED` vertices.

    For more it is a lower bound by iterated farthest-point search: from a sample to the farthest vertex of each, then from these, until the
    distance stops growing. On round bodies, which have many nearly equal chords, it was within 0.05 %.
    """
    if len(corners) <= _MOST_COMPARED:
        return _farthest(corners, corners)[0]
    found, far = _farthest(corners[:: len(corners) // _STARTS], corners)
    while (farther := _farthest(corners[far], corners))[0] > found:
        found, far = farther
    return found


def _farthest(some: np.ndarray, corners: np.ndarray) -> tuple[float, np.ndarray]:
    """Farthest-point query: largest distance between query points (n, 3) and vertices, and the indices of the farthest vertex of each."""
    largest, far, rows = 0.0, [], max(1, _DISTANCES // len(corners))
    for start in range(0, len(some), rows):
        distances = cdist(some[start : start + rows], corners)
        largest = max(largest, float(distances.max()))
        far.append(distances.argmax(axis=1))
    return largest, np.unique(np.concatenate(far))


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


def mass_properties(pieces: Sequence[ConvexPiece]) -> MassProperties:
    """Mass properties of the union of convex pieces at uniform density; where pieces overlap, the overlap counts twice.

    Exact for polyhedra, as a sum over signed tetrahedra between each triangle and an inner point. With edges a, b, c from that
    point and s = a + b + c: V = a·(b x c)/6, ∫x = V s/4, ∫xxᵀ = V (aaᵀ + bbᵀ + ccᵀ + ssᵀ)/20. Inertia = tr(C) 1 - C, where C is
    the covariance (second moment); its eigenvalues satisfy the triangle inequality as long as C is positive semidefinite.
    """
    origin = np.concatenate([piece.vertices for piece in pieces]).mean(axis=0, dtype=np.float64)
    corners = np.concatenate([(piece.vertices - origin)[piece.faces] for piece in pieces])
    volumes = dot(corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    sums = corners.sum(axis=1)
    volume = volumes.sum()
    center = dot(sums.T, volumes) / (4.0 * volume)
    second = np.einsum("f,fki,fkj->ij", volumes, corners, corners) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    covariance = second / (20.0 * volume) - np.outer(center, center)
    covariance = (covariance + covariance.T) / 2.0
    return MassProperties(float(volume), origin + center, np.trace(covariance) * np.eye(3) - covariance)


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """Planes of all collision shapes of a catalog, in compressed row layout.

    The pieces of entry e are first_piece[e] to first_piece[e + 1] - 1; the planes of piece p are first_plane[p] to first_plane[p + 1] - 1.
    """

    first_piece: np.ndarray
    """(entry + 1) int32."""
    first_plane: np.ndarray
    """(piece + 1) int32."""
    plane: np.ndarray
    """(plane, 4) float32: outward unit normal n and offset d [m] in the object's frame; the inside is n·x ≤ d."""


def hull_planes(piece: ConvexPiece) -> np.ndarray:
    """H-representation of a piece (plane, 4) float64: outward unit normal n and offset d [m] of each half-space n·x ≤ d.

    Computed from the hull of the vertices, not from the triangles: normals of thin triangles are unreliable.
    """
    equations = ConvexHull(piece.vertices.astype(np.float64)).equations
    _, index = np.unique(equations.round(_DECIMALS), axis=0, return_index=True)
    planes = equations[np.sort(index)]
    return np.concatenate([planes[:, :3], -planes[:, 3:]], axis=1)


def plane_table(catalog: Catalog) -> PlaneTable:
    """Collect the half-spaces of all entries' pieces."""
    pieces = [[hull_planes(piece) for piece in entry.pieces] for entry in catalog.bodies]
    planes = [plane for entry in pieces for plane in entry]
    first_piece = np.cumsum([0] + [len(entry) for entry in pieces])
    first_plane = np.cumsum([0] + [len(plane) for plane in planes])
    return PlaneTable(first_piece.astype(np.int32), first_plane.astype(np.int32), np.concatenate(planes).astype(np.float32))


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
    """Depth of the convex hull of a mesh, vertices (V, 3) and faces (F, 3), above the surface (directed Hausdorff distance), by half of
    the hull's thickness (its least width).

    0 of convex and of hollow bodies; 0.8 of a tube whose wall is a tenth of its diameter; 1 and more of a bowl, of a bracket, and of a
    plate with holes as wide as it is thick. Measured from samples of the hull to the triangles nearby. Returns the ratio; 0 of coplanar
    points."""
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
