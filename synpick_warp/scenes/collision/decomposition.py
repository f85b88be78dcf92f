"""Approximate convex decomposition of concave objects with CoACD."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synpick_warp.scenes.assets.meshes import connected_parts, is_watertight, merge_positions, signed_volume
from synpick_warp.scenes.collision.hulls import hull_volume
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import ConvexPiece, TriangleMesh
from synpick_warp.system.linear_algebra import DECIMALS

# Pieces below this fraction of the total volume are slivers that only cost contacts.
_MIN_PIECE = 1e-4
# If the pieces' volume is below this fraction of the mesh's, a part of the mesh was lost.
_MIN_COVER = 0.95
# CoACD's search is randomized; the same seed gives the same pieces.
_SEED = 0
# Monte Carlo tree search iterations for each cut. CoACD's default of 150 takes 1.7 times as long and fits no closer: a bowl whose hull
# has 0.749 l became 16 pieces of 0.262 l with 150, 0.261 l with 60, 0.277 l with 30.
_SEARCH_STEPS = 60
# A mesh with a larger fraction of its vertices inside the body is repaired (remeshed) first. Where a handle ends in a mug's wall it is
# 0.02; for a drill assembled from boxes and cylinders 0.24, which takes 18 times as long without repair.
_MAX_BURIED = 0.1
# Triangles whose height is below this fraction of their longest side have no area: single precision has rounded the corners.
_NEEDLE = 1e-6
# A closed surface has at least four triangles.
_MIN_FACES = 4
# Vertices sampled to estimate that fraction.
_SAMPLES = 512


@dataclass(frozen=True)
class ShapeRecipe:
    """Parameters of one object's collision shape. The cache's keys contain this class's repr: renaming anything empties all caches."""

    concave: bool
    """Convex decomposition instead of the convex hull."""
    hull_vertices: int
    """Maximum vertices of a convex hull."""
    piece_vertices: int
    """Maximum vertices of each convex piece."""
    pieces: int
    """Maximum convex pieces."""
    concavity: float
    """CoACD's concavity threshold."""


def decompose(mesh: TriangleMesh, recipe: ShapeRecipe) -> tuple[ConvexPiece, ...]:
    """Approximate convex decomposition of a concave mesh with CoACD (Wei et al., SIGGRAPH 2022).

    CoACD's manifold preprocessing, which remeshes the surface, takes two to five times as long for the real bowl and mug and thickens
    their walls (0.261 l instead of 0.230 for the bowl's pieces), and CoACD asks for it wherever two triangles intersect. So the mesh is
    preprocessed only if it is open, walls run inside the body, or a decomposition without it has lost a part. Repeated triangles, and
    those without area in an open mesh, are removed first: they keep CoACD busy for minutes.

    Returns:
        The pieces; none if CoACD finds none.
    """
    import coacd  # loads a native library of 20 MB, which is needed only for shapes that are not cached

    coacd.set_log_level("error")
    vertices, faces = merge_positions(mesh.vertices, mesh.faces)
    pieces: list[np.ndarray] = []
    volumes: list[float] = []
    faces = _without_repeats(faces)
    repair = _needs_repair(vertices, faces)
    if repair:  # Without its needles, a closed mesh would be open.
        vertices, faces = _without_needles(vertices, faces)
    if len(faces) < _MIN_FACES:
        return ()
    for mode in ("auto",) if repair else ("off", "auto"):
        hulls = coacd.run_coacd(
            coacd.Mesh(vertices.astype(np.float64), faces.astype(np.int32)),
            threshold=recipe.concavity,
            max_convex_hull=recipe.pieces,
            preprocess_mode=mode,
            mcts_iterations=_SEARCH_STEPS,
            seed=_SEED,
        )
        pieces = [points for points, _ in hulls]
        volumes = [hull_volume(points) for points in pieces]
        if sum(volumes) > _MIN_COVER * signed_volume(vertices, faces):
            break
    kept = [points for points, volume in zip(pieces, volumes, strict=True) if volume > _MIN_PIECE * sum(volumes)]
    return tuple(simplify_hull(points, recipe.piece_vertices) for points in kept)


def _without_repeats(faces: np.ndarray) -> np.ndarray:
    """Remove repeated triangles: of those with the same corners, one remains of the orientation that more of them have.

    None remains of as many of either orientation: merging vertices leaves such pairs, and they enclose nothing.
    """
    shift = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (shift + np.arange(3)) % 3, axis=1)
    corners, index = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    side = np.where(turned[:, 1] < turned[:, 2], 1, -1)
    surplus = np.bincount(index, weights=side, minlength=len(corners))[index]
    kept = np.flatnonzero(surplus * side > 0)
    return faces[np.sort(kept[np.unique(index[kept], return_index=True)[1]])]


def _without_needles(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove triangles of no area, but for rounding, and the vertices that no other triangle has."""
    corners = vertices[faces].astype(np.float64)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    used, index = np.unique(faces[doubled > _NEEDLE * sides**2], return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def _needs_repair(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether the mesh is open (not watertight), or much of it lies inside the body: CoACD would cut along inner walls for minutes."""
    return not is_watertight(faces) or _buried_fraction(vertices, faces, connected_parts(faces)) > _MAX_BURIED


def _buried_fraction(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> float:
    """Fraction of vertices inside other closed parts, estimated by generalized winding numbers (Jacobson et al., SIGGRAPH 2013).

    The solid angle Ω of a triangle with corners a, b, c relative to a point (van Oosterom and Strackee, 1983):
    tan(Ω/2) = a·(b x c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|).

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        part: Connected component of each vertex (V).
    """
    used = np.unique(faces)
    if (part[used] == part[used[0]]).all():
        return 0.0
    buried = []
    for vertex in used[:: -(-len(used) // _SAMPLES)]:
        a, b, c = np.moveaxis(vertices[faces[part[faces[:, 0]] != part[vertex]]] - vertices[vertex], 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        volume = np.einsum("fi,fi->f", a, np.cross(b, c))
        dots = (np.einsum("fi,fi->f", x, y) * z for x, y, z in ((a, b, lc), (b, c, la), (c, a, lb)))
        buried.append(round(float(np.arctan2(volume, la * lb * lc + sum(dots)).sum() / (2.0 * np.pi)), DECIMALS) > 0.5)
    return float(np.mean(buried))
