"""Assertions and measurements on convex pieces and closed meshes."""

import collections
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial import ConvexHull

from synpick_warp.scenes.assets.meshes import merge_positions, signed_volume
from synpick_warp.scenes.collision.hulls import mass_properties
from synpick_warp.scenes.types import ConvexPiece, TriangleMesh
from tests.twins.raycast import edges_match, first_hit


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


def assert_closed(mesh: TriangleMesh) -> None:
    """Closed, outward, with normals of length 1."""
    assert edges_match(merge_positions(mesh.vertices, mesh.faces)[1])
    assert signed_volume(mesh.vertices, mesh.faces) > 0
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-3


def is_convex(piece: ConvexPiece) -> bool:
    """Closed, outward, and no vertex more than a micrometre beyond a face."""
    corners = piece.vertices[piece.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = ((piece.vertices[None].astype(np.float64) - corners[:, :1]) * normal[:, None]).sum(axis=2)
    return edges_match(piece.faces) and signed_volume(piece.vertices, piece.faces) > 0 and height.max() < 1e-6


def filled(pieces: Iterable[ConvexPiece], points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Whether points (N, 3) lie in one of some convex pieces, at least `margin` deep [m]."""
    planes = [ConvexHull(piece.vertices.astype(float)).equations for piece in pieces]
    return np.any([(points @ each[:, :3].T + each[:, 3] <= -margin).all(axis=1) for each in planes], axis=0)


def felt(pieces: Iterable[ConvexPiece], origin: tuple[float, ...], direction: tuple[float, ...]) -> float:
    """Distance along a ray to the first of some pieces [m]."""
    return min(first_hit(piece.vertices, piece.faces, origin, direction) for piece in pieces)


def depth_within(pieces: Sequence[ConvexPiece], points: np.ndarray) -> float:
    """Depth of the deepest of points (N, 3) inside convex pieces [m]; below 0 outside of all."""
    planes = (ConvexHull(piece.vertices.astype(float)).equations for piece in pieces)
    return max((float(-(points @ each[:, :3].T + each[:, 3]).max(axis=1).min()) for each in planes), default=-np.inf)
