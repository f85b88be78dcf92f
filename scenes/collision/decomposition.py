"""Cover concave objects by convex pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from synpick_warp.scenes.collision.hulls import hull_volume, limited_hull
from synpick_warp.scenes.meshes import merge_positions, signed_volume
from synpick_warp.scenes.types import ConvexPiece, TriangleMesh

# Pieces of a decomposition below this share of the whole volume are slivers that only cost contacts.
_LEAST_PIECE = 1e-4
# Pieces that fill less than this share of the mesh's volume have lost a part of it.
_LEAST_COVER = 0.95
# CoACD searches at random; the same seed gives the same pieces.
_SEED = 0
# Steps of CoACD's tree search for each cut. Its own 150 take 1.7 times as long and fit no closer: a bowl of 0.749 l of hull became
# 16 pieces of 0.262 l with 150, 0.261 l with 60, 0.277 l with 30.
_SEARCH_STEPS = 60
# A surface of which a larger share lies inside the body is repaired first. Where a handle ends in a mug's wall it is 0.02; for a drill put
# together from boxes and cylinders 0.24, and without repair that took 180 s instead of 10.
_MOST_BURIED = 0.1
# Vertices that are looked at to find that share.
_SAMPLES = 512


@dataclass(frozen=True)
class ShapeRecipe:
    """How one object gets its collision shape."""

    concave: bool
    """Decompose, instead of taking the hull."""
    hull_vertices: int
    piece_vertices: int
    pieces: int
    concavity: float


def decompose(mesh: TriangleMesh, recipe: ShapeRecipe) -> tuple[ConvexPiece, ...]:
    """Cover a concave mesh by convex pieces with CoACD (Wei et al., SIGGRAPH 2022).

    CoACD's own repair, a finer surface around the first, takes two to five times as long for the real bowl and mug and thickens their
    walls (0.261 l instead of 0.230 for the bowl's pieces), and CoACD asks for it wherever two triangles cross. So the surface is cut
    as it is unless it is open, walls run inside the body, or the result has lost a part.
    """
    import coacd  # loads a native library of 20 MB, which nobody needs whose shapes are in the cache

    coacd.set_log_level("error")
    vertices, faces = merge_positions(mesh.vertices, mesh.faces)
    pieces: list[np.ndarray] = []
    volumes: list[float] = []
    faces = _without_opposites(faces)
    for mode in ("auto",) if _needs_repair(vertices, faces) else ("off", "auto"):
        found = coacd.run_coacd(
            coacd.Mesh(vertices.astype(np.float64), faces.astype(np.int32)),
            threshold=recipe.concavity,
            max_convex_hull=recipe.pieces,
            preprocess_mode=mode,
            mcts_iterations=_SEARCH_STEPS,
            seed=_SEED,
        )
        pieces = [points for points, _ in found]
        volumes = [hull_volume(points) for points in pieces]
        if sum(volumes) > _LEAST_COVER * signed_volume(vertices, faces):
            break
    kept = [points for points, volume in zip(pieces, volumes, strict=True) if volume > _LEAST_PIECE * sum(volumes)]
    return tuple(limited_hull(points, recipe.piece_vertices) for points in kept)


def _without_opposites(faces: np.ndarray) -> np.ndarray:
    """Drop pairs of triangles that lie back to back on the same corners: merging positions leaves some, and they enclose nothing."""
    shift = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (shift + np.arange(3)) % 3, axis=1)
    corners, index = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    side = np.where(turned[:, 1] < turned[:, 2], 1, -1)
    balanced = np.bincount(index, weights=side, minlength=len(corners)) == 0
    return faces[~balanced[index]]


def _needs_repair(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether the surface is open, or a good part of it lies inside the body: CoACD would cut along such inner walls for minutes."""
    start, end = faces.reshape(-1), faces[:, (1, 2, 0)].reshape(-1)
    edges, index = np.unique(np.sort(np.stack([start, end], axis=1), axis=1), axis=0, return_inverse=True)
    if np.bincount(index, weights=np.where(start < end, 1, -1), minlength=len(edges)).any():
        return True
    links = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(vertices), len(vertices)))
    _, part = connected_components(links, directed=False)
    return _buried_share(vertices, faces, part) > _MOST_BURIED


def _buried_share(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> float:
    """Share of the vertices that lie inside other closed parts, by winding numbers (Jacobson et al., SIGGRAPH 2013), from a sample.

    The solid angle Ω under which a point sees a triangle with corners a, b, c (van Oosterom and Strackee, 1983):
    tan(Ω/2) = a·(b x c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|).
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
        buried.append(np.arctan2(volume, la * lb * lc + sum(dots)).sum() / (2.0 * np.pi) > 0.5)
    return float(np.mean(buried))
