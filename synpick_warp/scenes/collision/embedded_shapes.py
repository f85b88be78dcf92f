"""Collision shapes of the embedded objects, computed once and shipped, so that a first bake does not wait for convex decomposition.

They are keyed by mesh and recipe, so that other settings, or objects that have changed, are decomposed as any others. The meshes follow
from sines and cosines, whose last bits depend on NumPy and the processor; therefore vertices count to 10 micrometres.

    python -m tools.embedded_shapes      # computes them again and writes the file, in a minute
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np

from synpick_warp.scenes.collision.decomposition import ShapeRecipe
from synpick_warp.scenes.types import ConvexPiece, Shape, TriangleMesh

FILE = Path(__file__).with_name("embedded_shapes.npz")
"""Arrays of `pack_pieces` for each key, named KEY.vertices, KEY.faces and KEY.counts."""
_GRID = 1e-5
# Sizes are multiples of 0.1 mm: away from the grid's limits by this fraction of a cell, rounding errors do not change a key.
_OFFSET = 0.25


def pack_pieces(pieces: Shape) -> dict[str, np.ndarray]:
    """Arrays of convex pieces: `vertices` (V, 3) and `faces` (F, 3) of all, and their `counts` (piece, 2)."""
    vertices, faces = (np.concatenate(rows) for rows in zip(*((piece.vertices, piece.faces) for piece in pieces), strict=True))
    return {"vertices": vertices, "faces": faces, "counts": np.array([(len(piece.vertices), len(piece.faces)) for piece in pieces])}


def unpack_pieces(vertices: np.ndarray, faces: np.ndarray, counts: np.ndarray) -> Shape:
    """Convex pieces of a shape from the arrays of `pack_pieces`."""
    ends = np.cumsum(counts, axis=0)[:-1]
    pairs = zip(np.split(vertices, ends[:, 0]), np.split(faces, ends[:, 1]), strict=True)
    return tuple(ConvexPiece(np.ascontiguousarray(v, np.float32), np.ascontiguousarray(f, np.int32)) for v, f in pairs)


def shape_key(mesh: TriangleMesh, recipe: ShapeRecipe) -> str:
    """Key of a mesh's shape (hexadecimal SHA-256)."""
    digest = hashlib.sha256(repr(recipe).encode())
    digest.update(np.floor(mesh.vertices.astype(np.float64) / _GRID + _OFFSET).astype("<i4").tobytes())
    digest.update(mesh.faces.astype("<i4").tobytes())
    return digest.hexdigest()


def embedded_shape(mesh: TriangleMesh, recipe: ShapeRecipe) -> Shape | None:
    """Collision shape of an embedded object, from the file of the package; None for other meshes and recipes."""
    return _read_shapes().get(shape_key(mesh, recipe))


@cache
def _read_shapes() -> dict[str, Shape]:
    """Read the embedded collision shapes, by their keys."""
    with np.load(FILE, allow_pickle=False) as data:
        keys = {name.partition(".")[0] for name in data.files}
        return {key: unpack_pieces(*(data[f"{key}.{name}"] for name in ("vertices", "faces", "counts"))) for key in keys}
