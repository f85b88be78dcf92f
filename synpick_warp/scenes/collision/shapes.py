"""Collision shapes of a catalog's objects, with a disk cache keyed by content (mesh, recipe, CoACD version).

Those of the embedded objects and of the models of YCB-Video are shipped, so that a first bake does not wait for convex decomposition. They
are keyed by mesh and recipe: with other settings, or after a change, objects are decomposed as any others. `tools.embedded_shapes` computes
them again.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from synpick_warp.configs.schema import Objects
from synpick_warp.errors import CatalogError, SynpickError
from synpick_warp.scenes.collision.decomposition import ShapeRecipe, decompose
from synpick_warp.scenes.collision.hulls import hull_volume
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import ConvexPiece, Shape, TriangleMesh
from synpick_warp.system.hardware.caches import USER_VARIABLE, user_cache
from synpick_warp.system.inputs.files import check_regular_file
from synpick_warp.system.inputs.paths import make_folder
from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated

MAX_CACHE_FILE = 2**26
"""Largest cache file [bytes]: 64 MiB; a decomposition has some 10 kB."""
# Part of the cache's key, as is the text of ShapeRecipe. Raise it with any change to simplification.py or decomposition.py that gives other
# shapes for the same input.
_RECIPE = 4
DECOMPOSITION_MEMORY = 2**33
"""Memory limit of a decomposition [bytes]: 8 GiB; the remeshing of a scan with two million triangles takes a few."""
HULL_LIMITS = Limits(120.0, 2**32)
"""Limits of the simplification of a convex hull: 120 s of processor time and 4 GiB; a scan with two million vertices takes seconds."""
_REMEDY = "repair the mesh, or set concave = false"
_LATE = "decimate the mesh, raise objects.decomposition_time, or set concave = false"
EMBEDDED_FILE, YCBV_FILE = (Path(__file__).with_name(f"{name}_shapes.npz") for name in ("embedded", "ycbv"))
"""Arrays of `pack_pieces` for each key, named KEY.vertices, KEY.faces and KEY.counts: of embedded objects, of models of YCB-Video."""
# Meshes follow from sines and cosines, whose last bits depend on NumPy and the processor; so vertices count to 10 micrometres [m].
_GRID = 1e-5
# Sizes are multiples of 0.1 mm: away from the grid's limits by this fraction of a cell, rounding errors do not change a key.
_OFFSET = 0.25


def default_cache_dir() -> Path:
    """Default cache folder, in the user's cache directory. Without a home directory: a path below the null device, where
    writing always fails, so that shapes are computed each time and a note says so."""
    return (user_cache() or Path(os.devnull)) / "synpick-warp" / "collision"


def collision_shapes(
    names: Sequence[str],
    meshes: Sequence[TriangleMesh],
    recipes: Sequence[ShapeRecipe],
    cache_dir: Path,
    report: Callable[[str], None],
    seconds: float = Objects.decomposition_time,
) -> list[Shape | CatalogError]:
    """Compute the collision shape of each mesh (convex hull, or convex decomposition), or read it from the cache.

    Those of known objects come with the program. Others are computed in isolated processes (`run_isolated`).
    What CoACD crashes on or cannot decompose gets its convex hull instead, and a line says so. If time or memory of this machine does not
    suffice, that is an error: elsewhere, or under other load, the same settings would give another shape.

    Args:
        names: Names of the objects, for progress and errors.
        meshes: One mesh per name.
        recipes: One recipe per name.
        cache_dir: Folder of the cache; created if missing. If it cannot be written, that is reported and shapes are computed each time.
        report: Called with each line of progress.
        seconds: Limit of a decomposition's processor time [s].

    Returns:
        The shape of each mesh, or an error if it has none because it has no volume.

    Raises:
        CatalogError: Time or memory does not suffice for objects, all of which are named.
    """
    jobs = [
        _Job(name, mesh, recipe, cache_dir / f"{_key(mesh, recipe)}.npz") for name, mesh, recipe in zip(names, meshes, recipes, strict=True)
    ]
    shapes: list[Shape | CatalogError | None] = [shipped_shape(job.mesh, job.recipe) or _load(job.file) for job in jobs]
    save, stopped = _Saver(report), []
    slow = {index: job for index, job in enumerate(jobs) if shapes[index] is None and job.recipe.concave}
    for index, result in _decompose_all(slow, seconds, report):
        job = jobs[index]
        if not isinstance(result, Failure):
            report(f"{job.name}: {len(result)} convex pieces")
            shapes[index] = save(job.file, result)
            continue
        if result.by_machine:
            stopped.append(f"{job.name}: its convex decomposition {result.reason}")
            continue
        report(f"{job.name}: its convex decomposition {result.reason}; its convex hull is used instead: {_REMEDY}")
        jobs[index] = replace(job, file=Path(os.devnull))  # The next bake may have another library.
    if stopped:
        raise CatalogError(f"{'; '.join(stopped)}; {_LATE}")
    missing = [index for index, shape in enumerate(shapes) if shape is None]
    calls = [(jobs[index].mesh.vertices, jobs[index].recipe.hull_vertices) for index in missing]
    for index, result in zip(missing, run_isolated(simplify_hull, calls, HULL_LIMITS), strict=True):
        if isinstance(result, ConvexPiece):
            shapes[index] = save(jobs[index].file, (result,))
        elif isinstance(result, Failure) and result.by_machine:
            raise CatalogError(f"{jobs[index].name}: its convex hull {result.reason}; decimate the mesh")
        else:
            said = f"its convex hull {result.reason}; repair the mesh" if isinstance(result, Failure) else str(result)
            shapes[index] = CatalogError(f"{jobs[index].name}: {said}")
    return [shape or () for shape in shapes]


@dataclass(frozen=True, eq=False)
class _Job:
    """Object whose collision shape is wanted: name, mesh, recipe (hull or decomposition), and the cache file of the shape."""

    name: str
    mesh: TriangleMesh
    recipe: ShapeRecipe
    file: Path


def _decompose_all(jobs: Mapping[int, _Job], seconds: float, report: Callable[[str], None]) -> Iterator[tuple[int, Shape | Failure]]:
    """Decompose objects; yields the pieces of each as soon as it and all before it are done, or why there are none."""
    if jobs:
        listed = ", ".join(job.name for job in jobs.values())
        report(f"decomposing {len(jobs)} concave objects, once, mostly in a minute, by {seconds:g} s of processor time at most: {listed}")
    results = run_isolated(decompose, [(job.mesh, job.recipe) for job in jobs.values()], Limits(seconds, DECOMPOSITION_MEMORY))
    for index, result in zip(jobs, results, strict=True):
        if isinstance(result, SynpickError):
            yield index, Failure(f"failed ({result})")
        else:
            yield index, result or Failure("found no convex pieces")


class _Saver:
    """Writes shapes into the cache; once that has failed, it writes no more."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._writable = True

    def __call__(self, file: Path, shape: Shape) -> Shape:
        """Write a shape and return it; the null device stands for no file."""
        if self._writable and file != Path(os.devnull):
            self._writable = _save(file, shape, self._report)
        return shape


def _key(mesh: TriangleMesh, recipe: ShapeRecipe) -> str:
    """Cache key of a collision shape: hash of recipe, version of CoACD, vertices and faces."""
    version = importlib.metadata.version("coacd") if recipe.concave else ""
    digest = hashlib.sha256(f"{_RECIPE} {recipe} {version} {mesh.vertices.shape} {mesh.faces.shape}".encode())
    digest.update(mesh.vertices.astype("<f4").tobytes())
    digest.update(mesh.faces.astype("<i4").tobytes())
    return digest.hexdigest()


def _load(file: Path) -> Shape | None:
    """Read a cache file; None if it is missing or damaged."""
    try:
        check_regular_file(file, MAX_CACHE_FILE, CatalogError)
        # Opened here, because np.load leaves a damaged file open.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            if sum(item.file_size for item in data.zip.infolist()) > MAX_CACHE_FILE:
                return None
            pieces = unpack_pieces(data["vertices"], data["faces"], data["counts"])
        valid = all(np.isfinite(p.vertices).all() and p.faces.min() >= 0 and p.faces.max() < len(p.vertices) for p in pieces)
        valid = valid and all(p.vertices.shape[1:] == p.faces.shape[1:] == (3,) and hull_volume(p.vertices) > 0.0 for p in pieces)
    except Exception:  # a damaged file raises nearly anything; whatever it is, the shape is computed again
        return None
    return pieces if valid and pieces else None


def _save(file: Path, pieces: Shape, report: Callable[[str], None]) -> bool:
    """Write a cache file atomically, since several bakes may share the folder. False if it cannot be written."""
    try:
        make_folder(file.parent)
        handle, temporary = tempfile.mkstemp(dir=file.parent, prefix=".", suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as stream:
                np.savez(stream, allow_pickle=False, **pack_pieces(pieces))
            os.replace(temporary, file)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        reason = f"{file.parent} cannot be written ({error.strerror})"
        report(f"collision shapes are not cached: {reason}; set {USER_VARIABLE} to a folder that can")
        return False
    return True


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


def shipped_shape(mesh: TriangleMesh, recipe: ShapeRecipe) -> Shape | None:
    """Collision shape of an embedded object or a model of YCB-Video, from the files of the package; None for other meshes and recipes."""
    return read_shipped_shapes().get(shape_key(mesh, recipe))


@cache
def read_shipped_shapes() -> dict[str, Shape]:
    """Read the shipped collision shapes, by their keys."""
    found = {}
    for file in (EMBEDDED_FILE, YCBV_FILE):
        with np.load(file, allow_pickle=False) as data:
            keys = {name.partition(".")[0] for name in data.files}
            found |= {key: unpack_pieces(*(data[f"{key}.{name}"] for name in ("vertices", "faces", "counts"))) for key in keys}
    return found
