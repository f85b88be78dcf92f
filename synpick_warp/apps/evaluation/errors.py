"""Pose errors ADD, ADD-S, rotation and translation error over many pairs of poses in float64, as the BOP toolkit defines them.

A pair is an estimated and a true pose of one object, rotations (P, 3, 3) and translations (P, 3) [m] from object to camera. ADD and ADD-S
are those of Hinterstoisser et al. (ACCV 2012); ADD-S is called ADI there. Distances are in metres, angles in degrees.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

_CHUNK = 2**15
"""Points that are transformed at once: what the cache holds; four times as fast as many more."""
LEAF_SIZE = 32
"""Vertices in a leaf of the k-d tree: a sixth faster than SciPy's 10 on models of 1,000 vertices."""
NEAR = 1.01
"""Distance that counts as a model's radius, relative to it: the matrices of result files may be off by 0.001."""
_QUERIED = 2**20
"""Points that the k-d tree is asked for at once; some 50 MB."""


class VertexSearch:
    """Distances to the nearest vertices of a model."""

    def __init__(self, vertices: np.ndarray) -> None:
        """Prepare a search.

        Args:
            vertices: (V, 3) [m].
        """
        self._vertices = vertices
        self._tree = KDTree(vertices, leafsize=LEAF_SIZE)
        self.center = vertices.mean(axis=0)
        """Centroid of the vertices (3,) [m]."""
        self.radius = float(np.linalg.norm(vertices - self.center, axis=1).max())
        """Largest distance of a vertex from the centroid [m]."""

    def mean_distances(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Mean distance from the vertices, moved by each pose, to the nearest vertex of the model in its own frame (ADD-S).

        Args:
            rotation: (P, 3, 3).
            translation: (P, 3) [m].

        Returns:
            (P,) [m].
        """
        result = np.empty(len(rotation))
        for rows in chunks(len(rotation), len(self._vertices), _QUERIED):
            points = self._vertices @ rotation[rows].transpose(0, 2, 1) + translation[rows, None]
            result[rows] = self._tree.query(points.reshape(-1, 3), workers=-1)[0].reshape(points.shape[:2]).mean(axis=1)
        return result


def chunks(pairs: int, vertices: int, points: int) -> Iterator[slice]:
    """Slices of pairs, each with at most `points` points or of a single pair."""
    step = max(1, points // max(vertices, 1))
    for start in range(0, pairs, step):
        yield slice(start, start + step)


def add_errors(
    estimated_rotation: np.ndarray,
    estimated_translation: np.ndarray,
    true_rotation: np.ndarray,
    true_translation: np.ndarray,
    vertices: np.ndarray,
) -> np.ndarray:
    """ADD: mean distance between corresponding vertices.

    Args:
        estimated_rotation: (P, 3, 3).
        estimated_translation: (P, 3) [m].
        true_rotation: (P, 3, 3).
        true_translation: (P, 3) [m].
        vertices: Vertices of the model (V, 3) [m].

    Returns:
        (P,) [m].
    """
    errors = np.empty(len(estimated_rotation))
    # R_e x + t_e - (R_g x + t_g) is affine in x.
    rotation, translation = estimated_rotation - true_rotation, estimated_translation - true_translation
    count, columns = len(vertices), np.ascontiguousarray(vertices.T)
    for rows in chunks(len(errors), count, _CHUNK):
        offsets = (rotation[rows].reshape(-1, 3) @ columns).reshape(-1, 3, count)
        offsets += translation[rows, :, None]
        offsets *= offsets
        errors[rows] = np.sqrt(offsets.sum(axis=1)).mean(axis=1)
    return errors


def adds_errors(
    estimated_rotation: np.ndarray,
    estimated_translation: np.ndarray,
    true_rotation: np.ndarray,
    true_translation: np.ndarray,
    vertices: np.ndarray,
    search: VertexSearch | None = None,
) -> np.ndarray:
    """ADD-S (ADI): mean distance from a vertex in the true pose to the nearest vertex in the estimated pose.

    Nearest neighbours are searched in the object's axes, so that one search structure serves all pairs.

    Args:
        estimated_rotation: (P, 3, 3); orthonormal.
        estimated_translation: (P, 3) [m].
        true_rotation: (P, 3, 3).
        true_translation: (P, 3) [m].
        vertices: Vertices of the model (V, 3) [m].
        search: Search of the vertices; None: it is built.

    Returns:
        (P,) [m].
    """
    inverse = np.linalg.inv(estimated_rotation)
    translation = np.einsum("pij,pj->pi", inverse, true_translation - estimated_translation)
    return (VertexSearch(vertices) if search is None else search).mean_distances(inverse @ true_rotation, translation)


def translation_errors(estimated_translation: np.ndarray, true_translation: np.ndarray) -> np.ndarray:
    """Distance between the origins of the object (P,) [m]."""
    return np.linalg.norm(estimated_translation - true_translation, axis=1)


def rotation_errors(estimated_rotation: np.ndarray, true_rotation: np.ndarray, symmetries: np.ndarray | None = None) -> np.ndarray:
    """Angle of the rotation between the poses, the smallest over the object's symmetries.

    Args:
        estimated_rotation: (P, 3, 3).
        true_rotation: (P, 3, 3).
        symmetries: Rotations (S, 3, 3) under which the object looks the same, the identity among them; None: the identity alone.

    Returns:
        (P,) from 0 to 180 [°].
    """
    relative = estimated_rotation.transpose(0, 2, 1) @ true_rotation
    if symmetries is not None and len(symmetries) > 1:
        # trace(A S) is a scalar product of Aᵀ and S; the largest one has the smallest angle.
        traces = relative.transpose(0, 2, 1).reshape(-1, 9) @ symmetries.reshape(-1, 9).T
        relative = relative @ symmetries[np.argmax(traces, axis=1)]
    # atan2 of sine and cosine, since arccos loses half of the digits at 0° and 180°.
    skew = 0.5 * (relative - relative.transpose(0, 2, 1))
    sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1), axis=1)
    cosine = 0.5 * (np.trace(relative, axis1=1, axis2=2) - 1.0)
    return np.degrees(np.arctan2(sine, cosine))
