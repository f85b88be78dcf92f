"""Likeness of shapes in any size and pose, by their shape distributions (D2; Osada et al., ACM TOG 2002)."""

from __future__ import annotations

import numpy as np

from synpick_warp.scenes.collision.depth import sample_surface
from synpick_warp.scenes.collision.hulls import hull_size

_PAIRS = 20_000
"""Pairs of points whose distances are measured."""
_QUANTILES = 64
# Largest difference between quantiles of distances, in mean distances, and between parts of the hull's volume, of shapes that look alike:
# more than that of a scan and itself with noise of 0.3 % of its diameter. Two cartons of similar proportions look alike as well.
_ALIKE = 0.025


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
