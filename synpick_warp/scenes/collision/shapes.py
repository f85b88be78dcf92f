"""Collision shapes of a catalog's objects, convex hulls or approximate convex decompositions by CoACD, with a disk cache keyed by content
(mesh, recipe, CoACD version).

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
from synpick_warp.scenes.assets.meshes import connected_parts, is_watertight, merge_positions, signed_volume
from synpick_warp.scenes.collision.hulls import hull_volume
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import ConvexPiece, Shape, TriangleMesh
from synpick_warp.system.hardware.kernels import USER_VARIABLE, user_cache
from synpick_warp.system.inputs.files import check_regular_file, make_folder
from synpick_warp.system.linear_algebra import DECIMALS
from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated

MAX_CACHE_FILE = 2**26
"""Largest cache file [bytes]: 64 MiB; a decomposition has some 10 kB."""
# Part of the cache's key, as is the text of ShapeRecipe. Raise it with any change to simplification.py or `decompose` that gives other
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
        cache_dir: Folder of the cache; created if missing. If it cannot be written, that is reported and shapes are computed each time.
        seconds: Limit of a decomposition's processor time [s].

    Returns the shape of each mesh, or an error if it has none because it has no volume. Raises CatalogError: time or memory does not
    suffice for objects, all of which are named."""
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
        """Write a shape and return it; the null device stands for no file. Atomic, since several bakes may share the folder."""
        if not self._writable or file == Path(os.devnull):
            return shape
        try:
            write_arrays(file, **pack_pieces(shape))
        except OSError as error:
            self._writable = False
            reason = f"{file.parent} cannot be written ({error.strerror})"
            self._report(f"collision shapes are not cached: {reason}; set {USER_VARIABLE} to a folder that can")
        return shape


def write_arrays(file: Path, **arrays: np.ndarray) -> None:
    """Write a cache file (NPZ) atomically, in a folder that need not exist. Raises OSError."""
    make_folder(file.parent)
    handle, temporary = tempfile.mkstemp(dir=file.parent, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        os.replace(temporary, file)
    except BaseException:
        os.unlink(temporary)
        raise


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
    piece_vertices: int
    pieces: int
    concavity: float
    """CoACD's concavity threshold."""


def decompose(mesh: TriangleMesh, recipe: ShapeRecipe) -> tuple[ConvexPiece, ...]:
    """Approximate convex decomposition of a concave mesh with CoACD (Wei et al., SIGGRAPH 2022).

    CoACD's manifold preprocessing, which remeshes the surface, takes two to five times as long for the real bowl and mug and thickens their
    walls (0.261 l instead of 0.230 for the bowl's pieces), and CoACD asks for it wherever two triangles intersect. So the mesh is
    preprocessed only if it is open, walls run inside the body, or a decomposition without it has lost a part. Repeated triangles, and those
    without area in an open mesh, are removed first: they keep CoACD busy for minutes. Returns the pieces; none if CoACD finds none."""
    import coacd  # loads a native library of 20 MB, which is needed only for shapes that are not cached

    coacd.set_log_level("error")
    vertices, faces = merge_positions(mesh.vertices, mesh.faces)
    pieces: list[np.ndarray] = []
    volumes: list[float] = []
    faces = _without_repeats(faces)
    # CoACD would cut along inner walls for minutes.
    repair = not is_watertight(faces) or _buried_fraction(vertices, faces, connected_parts(faces)) > _MAX_BURIED
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
    """Remove duplicate triangles: of triangles with the same vertices, one of the majority's orientation is kept.

    If both orientations are equally frequent, none is kept: merging vertices leaves pairs that enclose no volume.
    """
    shift = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (shift + np.arange(3)) % 3, axis=1)
    corners, index = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    side = np.where(turned[:, 1] < turned[:, 2], 1, -1)
    surplus = np.bincount(index, weights=side, minlength=len(corners))[index]
    kept = np.flatnonzero(surplus * side > 0)
    return faces[np.sort(kept[np.unique(index[kept], return_index=True)[1]])]


def _without_needles(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove degenerate triangles, whose area is zero up to rounding, and vertices that are no longer referenced."""
    corners = vertices[faces].astype(np.float64)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    used, index = np.unique(faces[doubled > _NEEDLE * sides**2], return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def _buried_fraction(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> float:
    """Fraction of vertices inside other closed parts, estimated by generalized winding numbers (Jacobson et al., SIGGRAPH 2013).

    The solid angle Ω of a triangle with corners a, b, c relative to a point (van Oosterom and Strackee, 1983):
    tan(Ω/2) = a·(b x c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|).

    `part`: connected component of each vertex (V)."""
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
