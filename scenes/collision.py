"""Collision shapes: convex hulls of few vertices, convex decompositions, and what they weigh. Kept on disk by content."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.meshes import merge_positions, signed_volume
from synpick_warp.scenes.shapes import ConvexPiece, TriangleMesh

# Part of the cache key: raise it when the same input shall give other shapes.
_RECIPE = 1
# A hull does not take a vertex that adds less than this share of its volume.
_LEAST_GAIN = 1e-4
# Pieces of a decomposition below this share of the whole volume are slivers that only cost contacts.
_LEAST_PIECE = 1e-4
# Pieces that fill less than this share of the mesh's volume have lost a part of it.
_LEAST_COVER = 0.95
# A hull is flat if it fills less than this share of the cube over its extent: 0.2 µm on a sheet of 0.2 m.
_FLAT = 1e-6
# CoACD searches at random; the same seed gives the same pieces.
_SEED = 0
# Steps of CoACD's tree search for each cut. Its own 150 take 1.7 times as long and fit no closer: a bowl of 0.749 l of hull became
# 16 pieces of 0.262 l with 150, 0.261 l with 60, 0.277 l with 30.
_SEARCH_STEPS = 60


@dataclass(frozen=True)
class ShapeRecipe:
    """How one object gets its collision shape."""

    concave: bool
    """Decompose, instead of taking the hull."""
    hull_vertices: int
    piece_vertices: int
    pieces: int
    concavity: float


@dataclass(frozen=True)
class MassProperties:
    """Of uniform density."""

    volume: float
    """[m³]"""
    center_of_mass: np.ndarray
    """(3) float64 [m]"""
    unit_inertia: np.ndarray
    """About the centre of mass, for 1 kg (3, 3) float64 [m²]."""


def default_cache_dir() -> Path:
    """Where shapes are kept unless told otherwise: the user's cache folder (XDG base directory specification)."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "synpick-warp" / "collision"


def hull_volume(points: np.ndarray) -> float:
    """Volume of the convex hull of points (N, 3) [m³]; 0 if they lie in a plane."""
    try:
        hull = ConvexHull(points.astype(np.float64))
    except QhullError:
        return 0.0
    return float(hull.volume) if hull.volume > _FLAT * np.ptp(points, axis=0).max() ** 3 else 0.0


def limited_hull(points: np.ndarray, limit: int) -> ConvexPiece:
    """Convex hull of at most `limit` of the points, chosen one by one so that each adds the most volume.

    What a point adds is exact: the pyramids over the triangles it sees, V = Σ max(0, n·p + d) A / 3.

    Args:
        points: (N, 3) [m].
        limit: Most vertices, at least 6.

    Raises:
        CatalogError: The points lie in a plane.
    """
    points = np.unique(points.astype(np.float32), axis=0).astype(np.float64)
    try:
        whole = ConvexHull(points)
    except QhullError as error:
        raise CatalogError("all vertices lie in one plane; a body needs a volume") from error
    candidates = points[whole.vertices]
    chosen = _extreme_points(candidates)
    hull = ConvexHull(candidates[chosen])
    while len(chosen) < limit:
        corners = hull.points[hull.simplices]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
        gains = np.maximum(candidates @ hull.equations[:, :3].T + hull.equations[:, 3], 0.0) @ areas / 3.0
        best = int(gains.argmax())
        if gains[best] < _LEAST_GAIN * whole.volume or best in chosen:
            break
        chosen.append(best)
        hull = ConvexHull(candidates[chosen])
    return _piece(hull)


def _extreme_points(points: np.ndarray) -> list[int]:
    """Indices of four to six points that span a volume: the outermost along each axis, then those that add most."""
    chosen = {int(index) for axis in range(3) for index in (points[:, axis].argmin(), points[:, axis].argmax())}
    first = points[min(chosen)]
    far = int(np.linalg.norm(points - first, axis=1).argmax())
    line = points[far] - first
    wide = int(np.linalg.norm(np.cross(points - first, line), axis=1).argmax())
    high = int(np.abs((points - first) @ np.cross(line, points[wide] - first)).argmax())
    spanning = [min(chosen), far, wide, high]
    # The four span a tetrahedron for sure; the axes' extremes alone may not.
    return list(dict.fromkeys([*spanning, *sorted(chosen)]))[:6]


def _piece(hull: ConvexHull) -> ConvexPiece:
    """The hull's vertices and its triangles, turned outward along shared edges: thin triangles have no normal to go by."""
    faces = hull.simplices.copy()
    corners = hull.points[faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    start = int(np.linalg.norm(doubled, axis=1).argmax())
    if doubled[start] @ hull.equations[start, :3] < 0.0:
        faces[start] = faces[start, ::-1]
    done, waiting = {start}, [start]
    while waiting:
        face = waiting.pop()
        edges = {(int(faces[face, k]), int(faces[face, (k + 1) % 3])) for k in range(3)}
        for neighbor in (int(n) for n in hull.neighbors[face]):
            if neighbor in done:
                continue
            if any((int(faces[neighbor, k]), int(faces[neighbor, (k + 1) % 3])) in edges for k in range(3)):
                faces[neighbor] = faces[neighbor, ::-1]
            done.add(neighbor)
            waiting.append(neighbor)
    used, index = np.unique(faces, return_inverse=True)
    return ConvexPiece(hull.points[used].astype(np.float32), index.reshape(-1, 3).astype(np.int32))


def decompose(mesh: TriangleMesh, recipe: ShapeRecipe) -> tuple[ConvexPiece, ...]:
    """Cover a concave mesh by convex pieces with CoACD (Wei et al., SIGGRAPH 2022).

    A closed surface is cut as it is. CoACD's own repair, a coarser surface around the first, takes twice as long and thickens
    thin walls (the bowl's pieces: 0.261 l instead of 0.230), so it is for open surfaces, and for results that lost a part.
    """
    import coacd  # loads a native library of 20 MB, which nobody needs whose shapes are in the cache

    coacd.set_log_level("error")
    vertices, faces = merge_positions(mesh.vertices, mesh.faces)
    inside = signed_volume(vertices, faces)
    for mode in ("off", "on") if _encloses(faces) else ("on",):
        found = coacd.run_coacd(
            coacd.Mesh(vertices.astype(np.float64), faces.astype(np.int32)),
            threshold=recipe.concavity,
            max_convex_hull=recipe.pieces,
            preprocess_mode=mode,
            mcts_iterations=_SEARCH_STEPS,
            seed=_SEED,
        )
        volumes = [hull_volume(points) for points, _ in found]
        if sum(volumes) > _LEAST_COVER * inside:
            break
    kept = [points for (points, _), volume in zip(found, volumes, strict=True) if volume > _LEAST_PIECE * sum(volumes)]
    return tuple(limited_hull(points, recipe.piece_vertices) for points in kept)


def _encloses(faces: np.ndarray) -> bool:
    """Whether each edge is run through as often one way as the other: a closed surface, even where parts of it touch."""
    start, end = faces[:, (0, 1, 2)].reshape(-1), faces[:, (1, 2, 0)].reshape(-1)
    edges, index = np.unique(np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1), axis=0, return_inverse=True)
    return not np.bincount(index, weights=np.where(start < end, 1.0, -1.0), minlength=len(edges)).any()


def collision_shapes(
    names: Sequence[str], meshes: Sequence[TriangleMesh], recipes: Sequence[ShapeRecipe], cache_dir: Path, report: Callable[[str], None]
) -> list[tuple[ConvexPiece, ...]]:
    """The collision shape of each mesh, from the cache where it has been made before.

    Args:
        names: Of the objects, for reports and errors.
        meshes: As long as `names`.
        recipes: As long as `names`.
        cache_dir: Folder of the cache; made if it is missing. If it cannot be written, that is reported and shapes are made each time.
        report: Takes one line of progress at a time.

    Raises:
        CatalogError: A mesh has no volume, or its decomposition failed.
    """
    files = [cache_dir / f"{_key(mesh, recipe)}.npz" for mesh, recipe in zip(meshes, recipes, strict=True)]
    shapes = [_load(file) for file in files]
    slow = [index for index, shape in enumerate(shapes) if shape is None and recipes[index].concave]
    if slow:
        report(f"decomposing {len(slow)} concave objects; up to a minute each, once: {', '.join(names[index] for index in slow)}")
    for index, shape in zip(slow, _decompose_all([(meshes[index], recipes[index]) for index in slow]), strict=True):
        if not shape:
            raise CatalogError(f"{names[index]}: no decomposition into convex pieces found; repair the mesh, or set concave = false")
        shapes[index] = shape
        report(f"{names[index]}: {len(shape)} convex pieces")
    writable = True
    for index, file in enumerate(files):
        if shapes[index] is None:
            try:
                shapes[index] = (limited_hull(meshes[index].vertices, recipes[index].hull_vertices),)
            except CatalogError as error:
                raise CatalogError(f"{names[index]}: {error}") from error
        elif index not in slow:
            continue
        if writable:
            writable = _save(file, shapes[index] or (), report)
    return [shape or () for shape in shapes]


def _decompose_all(jobs: list[tuple[TriangleMesh, ShapeRecipe]]) -> list[tuple[ConvexPiece, ...]]:
    """Decompose in as many processes as there are cores and jobs. CoACD has global state: threads would share it."""
    if len(jobs) <= 1:
        return [decompose(*job) for job in jobs]
    # Spawned, not forked: a copy of a process that has used a GPU cannot run.
    with ProcessPoolExecutor(min(len(jobs), os.cpu_count() or 1), mp_context=get_context("spawn")) as pool:
        try:
            return list(pool.map(decompose, *zip(*jobs, strict=True)))
        except BrokenProcessPool as error:
            raise CatalogError("a process that decomposed concave objects died, perhaps for want of memory; try again") from error


def _key(mesh: TriangleMesh, recipe: ShapeRecipe) -> str:
    version = importlib.metadata.version("coacd") if recipe.concave else ""
    search = (_RECIPE, _LEAST_GAIN, _LEAST_PIECE, _SEARCH_STEPS, _SEED)
    digest = hashlib.sha256(f"{search} {recipe} {version} {mesh.vertices.shape} {mesh.faces.shape}".encode())
    digest.update(mesh.vertices.astype("<f4").tobytes())
    digest.update(mesh.faces.astype("<i4").tobytes())
    return digest.hexdigest()


def _load(file: Path) -> tuple[ConvexPiece, ...] | None:
    """The pieces in a cache file; None if there is none, or a damaged one."""
    try:
        # Opened here, because np.load leaves a damaged file open.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            vertices, faces, counts = data["vertices"], data["faces"], data["counts"]
        ends = np.cumsum(counts, axis=0)[:-1]
        pairs = zip(np.split(vertices, ends[:, 0]), np.split(faces, ends[:, 1]), strict=True)
        pieces = tuple(ConvexPiece(np.ascontiguousarray(v, np.float32), np.ascontiguousarray(f, np.int32)) for v, f in pairs)
        sound = all(np.isfinite(p.vertices).all() and p.faces.min() >= 0 and p.faces.max() < len(p.vertices) for p in pieces)
    except Exception:  # a damaged file raises nearly anything; whatever it is, the shape is made anew
        return None
    return pieces if sound and pieces else None


def _save(file: Path, pieces: tuple[ConvexPiece, ...], report: Callable[[str], None]) -> bool:
    """Write a cache file whole or not at all: several bakes may share the folder. False if it cannot be written."""
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
        report(f"collision shapes are not kept: {file.parent} cannot be written ({error.strerror})")
        return False
    return True


def mass_properties(pieces: Sequence[ConvexPiece]) -> MassProperties:
    """Volume, centre of mass and inertia of the pieces' sum; where pieces overlap, the overlap counts twice.

    Exact for polyhedra: sums over the tetrahedra of each triangle with a point inside. For one with edges a, b, c from that point,
    V = a·(b x c)/6, ∫x = V s/4, ∫xxᵀ = V (aaᵀ + bbᵀ + ccᵀ + ssᵀ)/20, s = a + b + c; inertia = tr(C) 1 - C of the second moment C.
    So its eigenvalues keep the triangle inequality as long as C has no negative ones.
    """
    origin = np.concatenate([piece.vertices for piece in pieces]).mean(axis=0, dtype=np.float64)
    corners = np.concatenate([(piece.vertices - origin)[piece.faces] for piece in pieces])
    volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    sums = corners.sum(axis=1)
    volume = volumes.sum()
    center = volumes @ sums / (4.0 * volume)
    second = np.einsum("f,fki,fkj->ij", volumes, corners, corners) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    spread = second / (20.0 * volume) - np.outer(center, center)
    spread = (spread + spread.T) / 2.0
    return MassProperties(float(volume), origin + center, np.trace(spread) * np.eye(3) - spread)
