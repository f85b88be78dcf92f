"""The cup's rays in NumPy, from the rule in kernels.suction's docstrings: triangle by triangle instead of half-space by half-space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from synpick_warp.scenes.shapes import CatalogEntry, ConvexPiece
from tests.reference.raycast import rotation_of
from tests.reference.rays import first_hit


def ray_starts(cup: np.ndarray, rays: int, radius: float, tip: float) -> tuple[np.ndarray, np.ndarray]:
    """Starts (ray, 3) and common direction (3) in the world, for the cup's pose (7)."""
    angle = 2 * np.pi * np.arange(rays) / rays
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(rays, -tip)], axis=1)
    turn = rotation_of(cup[3:])
    return local @ turn.T + cup[:3], -turn[:, 2]


def is_inside(piece: ConvexPiece, point: np.ndarray) -> bool:
    """Whether a point lies behind all triangles."""
    corners = piece.vertices[piece.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool((((point - corners[:, 0]) * normal).sum(axis=1) <= 0.0).all())


def distance(entry: CatalogEntry, pose: np.ndarray, start: np.ndarray, way: np.ndarray) -> float:
    """From a ray's start to the object's collision shape at a pose (7) [m]: 0 inside, infinite if the ray passes it."""
    turn = rotation_of(pose[3:])
    local, direction = (start - pose[:3]) @ turn, way @ turn
    if any(is_inside(piece, local) for piece in entry.pieces):
        return 0.0
    return min(first_hit(piece.vertices, piece.faces, tuple(local), tuple(direction)) for piece in entry.pieces)


def catch(entries: Sequence[CatalogEntry | None], poses: np.ndarray, starts: np.ndarray, way: np.ndarray, reach: float) -> tuple[int, int]:
    """Rays that hit, and objects hit as bits; entry i at pose i, None: not there."""
    hits, caught = 0, 0
    for start in starts:
        along = [np.inf if entry is None else distance(entry, pose, start, way) for entry, pose in zip(entries, poses, strict=True)]
        nearest = int(np.argmin(along))
        if along[nearest] <= reach:
            hits += 1
            caught |= 1 << nearest
    return hits, caught
