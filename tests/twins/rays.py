"""Ray casting against a mesh in float64, and a mesh check: closed and consistently oriented."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def first_hit(vertices: np.ndarray, faces: np.ndarray, origin: ArrayLike, direction: ArrayLike) -> np.ndarray:
    """Distances (...) to the nearest triangle from points (..., 3) along unit directions (Möller and Trumbore, 1997); infinity: a miss."""
    corners = vertices[faces].astype(np.float64)
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    along = np.asarray(direction, np.float64)[..., None, :]
    p = np.cross(along, edge2)
    det = (edge1 * p).sum(axis=-1)
    usable = np.abs(det) > 1e-14
    inverse = 1.0 / np.where(usable, det, 1.0)
    t = np.asarray(origin, np.float64)[..., None, :] - corners[:, 0]
    u = (t * p).sum(axis=-1) * inverse
    q = np.cross(t, edge1)
    v = (q * along).sum(axis=-1) * inverse
    distance = (edge2 * q).sum(axis=-1) * inverse
    hit = usable & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (distance > 0)
    return np.where(hit, distance, np.inf).min(axis=-1)


def edges_match(faces: np.ndarray) -> bool:
    """True if each directed edge has exactly one opposite: the mesh is closed and consistently oriented."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    codes = edges[:, 0] * (faces.max() + 1) + edges[:, 1]
    opposite = edges[:, 1] * (faces.max() + 1) + edges[:, 0]
    return len(np.unique(codes)) == len(codes) and np.array_equal(np.sort(codes), np.sort(opposite))
