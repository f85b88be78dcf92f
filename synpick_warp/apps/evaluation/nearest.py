"""Nearest vertices of a model, for ADD-S: a k-d tree for few queries, a precomputed subdivision on CPU or GPU for many; both exact."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from synpick_warp.apps.evaluation.auc import LIMIT
from synpick_warp.stages.pose.nearest import NearestVertices
from synpick_warp.system.hardware.device import pick_device

MANY = 2**22
"""Queries from which on the subdivision pays for being built: as many take the k-d tree some two seconds."""
MAX_VERTICES = 2**17
"""Largest model that is subdivided: beyond it, building takes longer and more memory than it saves."""
LEAF_SIZE = 32
"""Vertices in a leaf of the k-d tree: a sixth faster than SciPy's 10 on models of 1,000 vertices."""
NEAR = 1.01
"""Distance that counts as a model's radius, relative to it: the matrices of result files may be off by 0.001."""
_ORTHONORMAL = 0.006
"""Largest element of Rᵀ R - 1 with which R lengthens nothing by more than one percent."""
_CHUNK = 2**20
"""Points that the k-d tree is asked for at once; some 50 MB."""


class VertexSearch:
    """Distances to the nearest vertices of a model."""

    def __init__(self, vertices: np.ndarray) -> None:
        """Prepare a search; what it needs is built when it is first asked.

        Args:
            vertices: (V, 3) [m].
        """
        self._vertices = vertices
        self.center = vertices.mean(axis=0)
        """Centroid of the vertices (3,) [m]."""
        self.radius = float(np.linalg.norm(vertices - self.center, axis=1).max())
        """Largest distance of a vertex from the centroid [m]."""

    @cached_property
    def _tree(self) -> KDTree:
        """k-d tree of the vertices (SciPy), for searches on the CPU. Built on first use."""
        return KDTree(self._vertices, leafsize=LEAF_SIZE)

    @cached_property
    def _subdivision(self) -> NearestVertices:
        """Exact grid of nearest vertices on a GPU, over the space in which poses are close. Built on first use."""
        return NearestVertices(self._vertices, self.center, LIMIT + 2.0 * NEAR * self.radius, pick_device("auto"))

    def mean_distances(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Mean distance from the vertices, moved by each pose, to the nearest vertex of the model in its own frame (ADD-S).

        Args:
            rotation: (P, 3, 3).
            translation: (P, 3) [m].

        Returns:
            (P,) [m].
        """
        result = np.empty(len(rotation))
        count = len(self._vertices)
        # Poses that are too far off to be matched may lead out of the subdivision.
        offset = np.linalg.norm(rotation @ self.center + translation - self.center, axis=1)
        error = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
        inside = (offset <= LIMIT + NEAR * self.radius) & (error <= _ORTHONORMAL)
        if count > MAX_VERTICES or count * int(inside.sum()) < MANY:
            inside[:] = False
        if inside.any():
            result[inside] = self._subdivision.mean_distances(rotation[inside], translation[inside])
        outside = np.flatnonzero(~inside)
        for part in chunks(len(outside), count, _CHUNK):
            rows = outside[part]
            points = self._vertices @ rotation[rows].transpose(0, 2, 1) + translation[rows, None]
            result[rows] = self._tree.query(points.reshape(-1, 3), workers=-1)[0].reshape(points.shape[:2]).mean(axis=1)
        return result


def chunks(pairs: int, vertices: int, points: int) -> Iterator[slice]:
    """Slices of pairs, each with at most `points` points or of a single pair."""
    step = max(1, points // max(vertices, 1))
    for start in range(0, pairs, step):
        yield slice(start, start + step)
