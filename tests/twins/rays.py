"""Ray casting of single rays against a mesh in float64, and a mesh check: closed and consistently oriented."""

from __future__ import annotations

import numpy as np


def first_hit(vertices: np.ndarray, faces: np.ndarray, origin: tuple[float, float, float], direction: tuple[float, float, float]) -> float:
    """Distance to the nearest triangle along a unit direction (Möller and Trumbore, 1997); infinity: a miss."""
    corners = vertices[faces].astype(np.float64)
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, edge2)
    det = (edge1 * p).sum(axis=1)
    usable = np.abs(det) > 1e-14
    inverse = 1.0 / np.where(usable, det, 1.0)
    t = np.array(origin) - corners[:, 0]
    u = (t * p).sum(axis=1) * inverse
    q = np.cross(t, edge1)
    v = (q @ np.array(direction)) * inverse
    distance = (edge2 * q).sum(axis=1) * inverse
    hit = usable & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (distance > 0)
    return float(distance[hit].min()) if hit.any() else float("inf")


def edges_match(faces: np.ndarray) -> bool:
    """True if each directed edge has exactly one opposite: the mesh is closed and consistently oriented."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    codes = edges[:, 0] * (faces.max() + 1) + edges[:, 1]
    opposite = edges[:, 1] * (faces.max() + 1) + edges[:, 0]
    return len(np.unique(codes)) == len(codes) and np.array_equal(np.sort(codes), np.sort(opposite))
