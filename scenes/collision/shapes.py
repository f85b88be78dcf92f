"""Collision shapes of a catalog's objects, with a disk cache keyed by content (mesh, recipe, CoACD version)."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.inputs.files import check_regular_file
from synpick_warp.scenes.collision.decomposition import ShapeRecipe
from synpick_warp.scenes.collision.hulls import hull_volume
from synpick_warp.scenes.collision.parallel import decompose_all
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import ConvexPiece, TriangleMesh
from synpick_warp.system.caches import USER_VARIABLE, user_cache

MAX_CACHE_FILE = 2**26
"""Largest cache file [bytes]: 64 MiB; a decomposition has some 10 kB."""
# Part of the cache's key, as is the text of ShapeRecipe. Raise it with any change to simplification.py or decomposition.py that gives other
# shapes for the same input.
_RECIPE = 3


def default_cache_dir() -> Path:
    """Default cache folder, in the user's cache directory. Without a home directory: a path below the null device, where
    writing always fails, so that shapes are computed each time and a note says so."""
    return (user_cache() or Path(os.devnull)) / "synpick-warp" / "collision"


def collision_shapes(
    names: Sequence[str], meshes: Sequence[TriangleMesh], recipes: Sequence[ShapeRecipe], cache_dir: Path, report: Callable[[str], None]
) -> list[tuple[ConvexPiece, ...]]:
    """Compute the collision shape of each mesh (convex hull, or convex decomposition), or read it from the cache.

    Args:
        names: Names of the objects, for progress and errors.
        meshes: One mesh per name.
        recipes: One recipe per name.
        cache_dir: Folder of the cache; created if missing. If it cannot be written, that is reported and shapes are computed each time.
        report: Called with each line of progress.

    Raises:
        CatalogError: A mesh has no volume, or its decomposition failed.
    """
    files = [cache_dir / f"{_key(mesh, recipe)}.npz" for mesh, recipe in zip(meshes, recipes, strict=True)]
    shapes = [_load(file) for file in files]
    missing = [index for index, shape in enumerate(shapes) if shape is None]
    slow = [index for index in missing if recipes[index].concave]
    if slow:
        report(f"decomposing {len(slow)} concave objects, once, up to a minute each: {', '.join(names[index] for index in slow)}")
    jobs = [(names[index], meshes[index], recipes[index]) for index in slow]
    writable = True
    # Each shape is cached as soon as it is computed, so that a stopped bake need not repeat it.
    for index, shape in zip(slow, decompose_all(jobs), strict=True):
        if not shape:
            raise CatalogError(f"{names[index]}: CoACD found no convex pieces; repair the mesh, or set concave = false")
        report(f"{names[index]}: {len(shape)} convex pieces")
        shapes[index] = shape
        writable = writable and _save(files[index], shape, report)
    for index in (index for index in missing if not recipes[index].concave):
        try:
            shape = (simplify_hull(meshes[index].vertices, recipes[index].hull_vertices),)
        except CatalogError as error:
            raise CatalogError(f"{names[index]}: {error}") from error
        shapes[index] = shape
        writable = writable and _save(files[index], shape, report)
    return [shape or () for shape in shapes]


def _key(mesh: TriangleMesh, recipe: ShapeRecipe) -> str:
    version = importlib.metadata.version("coacd") if recipe.concave else ""
    digest = hashlib.sha256(f"{_RECIPE} {recipe} {version} {mesh.vertices.shape} {mesh.faces.shape}".encode())
    digest.update(mesh.vertices.astype("<f4").tobytes())
    digest.update(mesh.faces.astype("<i4").tobytes())
    return digest.hexdigest()


def _load(file: Path) -> tuple[ConvexPiece, ...] | None:
    """Read a cache file; None if it is missing or damaged."""
    try:
        check_regular_file(file, MAX_CACHE_FILE, CatalogError)
        # Opened here, because np.load leaves a damaged file open.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            if sum(item.file_size for item in data.zip.infolist()) > MAX_CACHE_FILE:
                return None
            vertices, faces, counts = data["vertices"], data["faces"], data["counts"]
        ends = np.cumsum(counts, axis=0)[:-1]
        pairs = zip(np.split(vertices, ends[:, 0]), np.split(faces, ends[:, 1]), strict=True)
        pieces = tuple(ConvexPiece(np.ascontiguousarray(v, np.float32), np.ascontiguousarray(f, np.int32)) for v, f in pairs)
        valid = all(np.isfinite(p.vertices).all() and p.faces.min() >= 0 and p.faces.max() < len(p.vertices) for p in pieces)
        valid = valid and all(p.vertices.shape[1:] == p.faces.shape[1:] == (3,) and hull_volume(p.vertices) > 0.0 for p in pieces)
    except Exception:  # a damaged file raises nearly anything; whatever it is, the shape is computed again
        return None
    return pieces if valid and pieces else None


def _save(file: Path, pieces: tuple[ConvexPiece, ...], report: Callable[[str], None]) -> bool:
    """Write a cache file atomically, since several bakes may share the folder. False if it cannot be written."""
    vertices, faces = (np.concatenate(rows) for rows in zip(*((piece.vertices, piece.faces) for piece in pieces), strict=True))
    counts = np.array([(len(piece.vertices), len(piece.faces)) for piece in pieces])
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=file.parent, prefix=".", suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as stream:
                np.savez(stream, vertices=vertices, faces=faces, counts=counts)
            os.replace(temporary, file)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        reason = f"{file.parent} cannot be written ({error.strerror})"
        report(f"collision shapes are not cached: {reason}; set {USER_VARIABLE} to a folder that can")
        return False
    return True
