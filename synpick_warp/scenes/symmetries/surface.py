"""Point sample of a mesh's surface, and the two-sided Hausdorff distance between the surface and itself under a rigid transform.

Likeness of shapes in any size and pose is that of their shape distributions (D2; Osada et al., ACM TOG 2002).
"""

import numpy as np
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from synpick_warp.scenes.assets.meshes import merge_positions
from synpick_warp.scenes.collision.hulls import hull_size, sample_surface
from synpick_warp.system.linear_algebra import DECIMALS, dot, matmul, norm

_DENSE = 60_000
"""Number of sample points to which distances are measured."""
_QUERIES = 2_000
"""Number of sample points, and maximum number of vertices, in the subset from which distances are measured first. Vertices are included,
since the tips of small features fall between sample points."""
_TRIANGLES = 8
"""Points of the dense sample to whose triangles distances are measured where those to tangent planes are too large."""
_APPROXIMATE = 2.0
"""Relative error of the nearest point of the sample where it only has to be within a distance."""
_NEIGHBOURS, _LEAF = 4, 20
"""Points of the dense sample whose tangent planes are tried: beside an edge, the nearest point may lie on the other side of it; and of a
leaf of the tree by which they are found, a fifth faster than with SciPy's 10, which stay where neighbours are approximated."""
_THIN, _COARSE = 6_000, 150
"""Points of the samples by which candidates are ranked."""
_GAP = 2.0
"""Distance between neighbours of the dense sample, in its mean spacing; displacements along the surface below it do not count."""
_PAIRS = 20_000
"""Pairs of points whose distances are measured."""
_QUANTILES = 64
# Largest difference between quantiles of distances, in mean distances, and between parts of the hull's volume, of shapes that look alike:
# more than that of a scan and itself with noise of 0.3 % of its diameter. Two cartons of similar proportions look alike as well.
_ALIKE = 0.025


class SampledSurface:
    """Dense sample of a mesh's surface (area-weighted, with a fixed seed) for nearest-point distances."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        positions, faces = merge_positions(vertices.astype(np.float64), faces)
        corners = positions[faces]
        crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = norm(crosses) / 2.0
        corners, crosses, areas = (each[areas > 0.0] for each in (corners, crosses, areas))
        random = np.random.default_rng(0)
        rows = np.searchsorted(np.cumsum(areas), (np.arange(_DENSE) + random.random(_DENSE)) * areas.sum() / _DENSE).clip(
            max=len(areas) - 1
        )
        self.corners, self.rows = corners, rows
        root, share = np.sqrt(random.random(_DENSE)), random.random(_DENSE)
        self.weights = np.stack([1.0 - root, root * (1.0 - share), root * share], axis=1)
        self.points = np.einsum("nc,nci->ni", self.weights, corners[rows])
        self.normals = crosses[rows] / (2.0 * areas[rows, None])
        self.area = float(areas.sum())
        self.center = dot(corners.mean(axis=1).T, areas) / self.area
        """Centroid of the surface, through which each axis of symmetry passes."""
        offsets = self.points - self.center
        self.covariance = matmul(offsets.T, offsets) / _DENSE
        used = np.unique(faces)
        picked = [random.permutation(_DENSE)[:_QUERIES], random.permutation(used)[:_QUERIES]]
        self.tree, self.exact, self.thin = KDTree(self.points), KDTree(self.points, _LEAF), KDTree(self.points[:: _DENSE // _THIN])
        queries = np.concatenate([self.points[picked[0]], positions[picked[1]]])
        # In the order of the tree: neighbours are found a third faster one after another.
        self.queries = queries[np.argsort(np.argsort(self.tree.indices, kind="stable")[self.tree.query(queries)[1]], kind="stable")]
        self.every = np.concatenate([self.points[self.tree.indices], positions[np.sort(random.permutation(used)[:_DENSE])]])
        """The sample, and its number of vertices at most."""
        self.spread, self.nearest = KDTree(self.queries).query(self.every)
        self.coarse = self.points[picked[0][:_COARSE]]
        self.gap = _GAP * float(np.sqrt(self.area / _DENSE))
        self.facets = _facet_normals(crosses, areas)

    def distances(self, points: np.ndarray, limit: float = np.inf) -> np.ndarray:
        """Distances (N) of points to the surface [m], exact up to twice the limit."""
        distance, index = self.exact.query(points, _NEIGHBOURS, distance_upper_bound=2.0 * (limit + self.gap))
        index = np.minimum(index, _DENSE - 1)  # Of none within the bound the distance is infinite.
        along = dot(points[:, None] - self.points[index], self.normals[index])
        aside = np.sqrt(np.maximum(distance**2 - along**2, 0.0))
        return np.hypot(along, np.maximum(aside - self.gap, 0.0)).min(axis=1)

    def rough_deviation(self, matrix: np.ndarray, limit: float) -> float:
        """Lower bound of `deviation`, from subsamples: beyond the limit, the first that is found."""
        off = 0.0
        for points in (self.coarse, self.queries):
            off = max(off, *(self.distances(moved, limit).max() for moved in _both_ways(points, matrix)))
            if off > limit:
                break
        return float(off)

    def deviation(self, matrix: np.ndarray, limit: float = np.inf) -> float:
        """Hausdorff distance between the surface and itself, moved by a rigid 4 x 4 matrix [m], from all points.

        With a limit, that of a subsample unless a point is beyond the limit; and a lower bound if many are. A point is passed over if the
        nearest one of the subsample is so close to the surface that it cannot be beyond, or if a point of the sample is near.
        """
        off = max(self.distances(moved, limit).max() for moved in _both_ways(self.coarse, matrix))
        if off > limit:
            return float(off)
        known = [self.distances(moved, limit) for moved in _both_ways(self.queries, matrix)]
        off = max(off, *(distances.max() for distances in known))
        for way, distances in enumerate(known):
            within = off if limit == np.inf else limit
            left = _both_ways(self.every[distances[self.nearest] + self.spread > within], matrix)[way]
            left = left[np.isinf(self.tree.query(left, eps=_APPROXIMATE, distance_upper_bound=within)[0])]
            far = self.distances(left, limit)
            beyond = far > within
            far[beyond] = np.minimum(far[beyond], self._triangle_distances(left[beyond]))
            off = max(off, far.max(initial=0.0))
        return float(off)

    def _triangle_distances(self, points: np.ndarray) -> np.ndarray:
        """Distances (N) of points to the triangles of the nearest points of the sample, which has gaps [m]."""
        if not len(points):
            return np.zeros(0)
        index = self.tree.query(points, _TRIANGLES)[1]
        corners = self.corners[self.rows[index]].reshape(-1, 3, 3)
        again = np.repeat(points, _TRIANGLES, axis=0)
        return norm(closest_point(corners, again) - again).round(DECIMALS).reshape(-1, _TRIANGLES).min(axis=1)

    def mean_distances(self, rotations: np.ndarray) -> np.ndarray:
        """Mean distances (N) of a coarse sample to another one, when rotated about the centroid by (N, 3, 3) [m]."""
        moved = matmul(self.coarse - self.center, rotations.transpose(0, 2, 1)) + self.center
        return self.thin.query(moved.reshape(-1, 3))[0].reshape(len(rotations), -1).mean(axis=1)


def _both_ways(points: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3), moved by a rigid 4 x 4 matrix and by its inverse."""
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    return matmul(points, rotation.T) + translation, matmul(points - translation, rotation)


def _facet_normals(crosses: np.ndarray, areas: np.ndarray, count: int = 16) -> np.ndarray:
    """Directions of the largest flat regions, at most `count`, without opposite ones (N, 3)."""
    normals = crosses / (2.0 * areas[:, None])
    normals = normals * np.where(normals[:, [2]] + 1e-3 * normals[:, [1]] + 1e-6 * normals[:, [0]] < 0.0, -1.0, 1.0)
    cells, index = np.unique(np.round(normals * 20.0), axis=0, return_inverse=True)
    total = np.zeros((len(cells), 3))
    np.add.at(total, index.reshape(-1), normals * areas[:, None])
    length = norm(total)
    order = np.argsort(-length, kind="stable")[:count]
    return total[order][length[order] > 0.01 * areas.sum()] / length[order][length[order] > 0.01 * areas.sum()][:, None]


def shape_profile(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Quantiles of the distances between points of a surface, by their mean, and the hull's compactness; the same in any size and pose."""
    points = sample_surface(vertices, faces, 2 * _PAIRS)
    points = points[np.random.default_rng(0).permutation(len(points))]
    distances = np.linalg.norm(points[:_PAIRS] - points[_PAIRS:], axis=1)
    hull = hull_size(vertices)
    return np.append(np.quantile(distances, (np.arange(_QUANTILES) + 0.5) / _QUANTILES) / distances.mean(), hull.volume / hull.diameter**3)


def look_alike(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two shapes, by their profiles, cannot be told apart but for their size."""
    return bool(np.abs(one - other).max() < _ALIKE)
