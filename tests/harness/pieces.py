"""Assertions on convex pieces."""

from __future__ import annotations

import collections

import numpy as np

from synpick_warp.scenes.collision.hulls import mass_properties
from synpick_warp.scenes.types import ConvexPiece


def assert_valid(piece: ConvexPiece) -> None:
    """Closed, outward, convex, and no vertex unused."""
    edges = collections.Counter((int(face[k]), int(face[(k + 1) % 3])) for face in piece.faces for k in range(3))
    assert all(count == 1 and edges[end, start] == 1 for (start, end), count in edges.items())
    assert set(piece.faces.reshape(-1)) == set(range(len(piece.vertices)))
    corners = piece.vertices[piece.faces].astype(np.float64)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.ptp(piece.vertices, axis=0).max()
    heights = np.einsum("fi,fvi->fv", doubled, piece.vertices[None] - corners[:, :1])
    assert heights.max() <= 1e-5 * size**3
    assert mass_properties([piece]).volume > 0.0
