"""The object set of a bake, from a folder of models or embedded, with collision shapes and mass properties."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist
from trimesh.bounds import oriented_bounds

from synpick_warp.configs.schema import Config, ObjectRow, Objects, Tote
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.appearance import Finish
from synpick_warp.scenes.collision.decomposition import ShapeRecipe
from synpick_warp.scenes.collision.hulls import hull_volume, mass_properties
from synpick_warp.scenes.collision.shapes import collision_shapes, default_cache_dir
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.meshes import SUFFIXES, read_mesh, signed_volume
from synpick_warp.scenes.models_info import ModelInfo, bop_files, read_models_info
from synpick_warp.scenes.types import Catalog, CatalogEntry, ConvexPiece, Material, RawObject, TriangleMesh

_MILLIMETRE = 1e-3
# Smaller bodies vanish in the contact gap, and come from files in another unit than expected.
_LEAST_DIAMETER = 2e-3
# An origin farther than this many diameters from the farthest vertex lies well outside the body, whose bounding sphere about
# the origin (which spaces the drop) would be mostly empty.
_FARTHEST_ORIGIN = 1.5
# Masses outside have no inverse, or none of use, in 32-bit numbers [kg].
_MASSES = (1e-7, 1e4)
_UNITS = "files named obj_NNNNNN.ply are read in millimetres, all others in metres"


def _say_nothing(line: str) -> None:
    """A `report` for callers that show no progress."""


def load_catalog(config: Config, cache_dir: Path | None = None, report: Callable[[str], None] = _say_nothing) -> Catalog:
    """Make the catalog that `config` asks for.

    `bake.models` names a BOP model folder (obj_NNNNNN.ply in millimetres, models_info.json), or a folder of .ply, .obj and .glb meshes in
    metres, which get obj_ids from 1 in the order of their names. Empty: the embedded objects.

    Args:
        config: A checked configuration.
        cache_dir: Where collision shapes are kept; None: `default_cache_dir()`.
        report: Takes one line of progress at a time.

    Raises:
        CatalogError: The folder or one of its files cannot be used, or an object is too large for the tote or has no sensible mass.
    """
    folder = Path(config.bake.models).expanduser()
    raws = _read_folder(folder, config, report) if config.bake.models else procedural_objects()
    origins = [str(raw.source or raw.name) for raw in raws]
    hulls = [_checked_hull_volume(raw, origin, config) for raw, origin in zip(raws, origins, strict=True)]
    masses = [_checked_mass(raw, hull, origin, config) for raw, hull, origin in zip(raws, hulls, origins, strict=True)]
    recipes = [_recipe(raw, hull, config.objects) for raw, hull in zip(raws, hulls, strict=True)]
    shapes = collision_shapes([raw.name for raw in raws], [raw.mesh for raw in raws], recipes, cache_dir or default_cache_dir(), report)
    entries = [_entry(raw, pieces, mass) for raw, pieces, mass in zip(raws, shapes, masses, strict=True)]
    _report_never_drawn(entries, config.arrangement.volume, report)
    return Catalog(tuple(sorted(entries, key=lambda entry: entry.obj_id)))


def diameter(vertices: np.ndarray) -> float:
    """Largest distance of two of the points (N, 3) [m]; they must span a volume."""
    corners = vertices[ConvexHull(vertices.astype(np.float64)).vertices].astype(np.float64)
    # In blocks, since fine round meshes have tens of thousands of corners.
    return max(float(cdist(corners[start : start + 1024], corners).max()) for start in range(0, len(corners), 1024))


def _read_folder(folder: Path, config: Config, report: Callable[[str], None]) -> list[RawObject]:
    """Read all models of a folder, ordered by obj_id."""
    if not folder.is_dir():
        raise CatalogError(f"models folder {folder}: no such folder; give a BOP model folder, or one of OBJ, GLB or PLY meshes")
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
    except OSError as error:
        raise CatalogError(f"models folder {folder}: cannot be listed ({error.strerror})") from error
    if not files:
        raise CatalogError(f"models folder {folder}: no models in it; needed are obj_NNNNNN.ply, or .obj, .glb or .ply meshes")
    models = bop_files(files)
    if models:
        if ignored := len(files) - len(models):
            report(f"models folder {folder}: {ignored} meshes that are not named obj_NNNNNN.ply are ignored")
        infos = read_models_info(folder / "models_info.json", models)
        return [_read_bop(obj_id, file, infos.get(obj_id, ModelInfo()), config) for obj_id, file in sorted(models.items())]
    for first, second in itertools.pairwise(files):
        if first.stem == second.stem:
            raise CatalogError(f"models folder {folder}: {first.name} and {second.name} have the same name; keep one of them")
    return [_read_own(obj_id, file, config) for obj_id, file in enumerate(files, 1)]


def _read_bop(obj_id: int, file: Path, info: ModelInfo, config: Config) -> RawObject:
    """Read a model of a BOP folder. The object table's row of its obj_id counts if the diameter agrees."""
    mesh, finish = read_mesh(file, _MILLIMETRE)
    size = _diameter_or_zero(mesh)
    tolerance = config.objects.diameter_tolerance
    if info.diameter is not None and size > 0.0 and not _near(size, info.diameter, tolerance):
        raise CatalogError(
            f"{file}: diameter {size * 1e3:.4g} mm, but models_info.json says {info.diameter * 1e3:.4g}; both must be in millimetres"
        )
    row = next((row for row in config.object_rows if row.id == obj_id and _fits(row, size, tolerance)), None)
    raw = _raw(obj_id, file, mesh, finish, row, config.objects)
    return replace(raw, symmetries_discrete=info.symmetries_discrete, symmetries_continuous=info.symmetries_continuous, source=file)


def _read_own(obj_id: int, file: Path, config: Config) -> RawObject:
    """Read a mesh of a user's own. Its obj_id is only a count, so rows of the object table are found by name (and diameter) instead."""
    mesh, finish = read_mesh(file, 1.0)
    size = _diameter_or_zero(mesh)
    row = next((row for row in config.object_rows if row.name == file.stem and _fits(row, size, config.objects.diameter_tolerance)), None)
    return _raw(obj_id, file, mesh, finish, row, config.objects)


def _raw(obj_id: int, file: Path, mesh: TriangleMesh, finish: Finish, row: ObjectRow | None, objects: Objects) -> RawObject:
    """What the file says of its surface counts before the row, the row before the general settings."""
    general = row or objects
    material = Material(
        finish.color,
        finish.texture,
        general.metallic if finish.metallic is None else finish.metallic,
        general.roughness if finish.roughness is None else finish.roughness,
    )
    return RawObject(
        obj_id=obj_id,
        name=row.name if row and row.name else file.stem,
        mesh=mesh,
        material=material,
        mass=row.mass if row else None,
        concave=row.concave if row else None,
        symmetries_discrete=(),
        symmetries_continuous=(),
        source=None,
    )


def _diameter_or_zero(mesh: TriangleMesh) -> float:
    """Diameter [m]; 0 for a flat mesh, which is reported later with all that is wrong about sizes."""
    return diameter(mesh.vertices) if hull_volume(mesh.vertices) > 0.0 else 0.0


def _near(value: float, expected: float, tolerance: float) -> bool:
    return abs(value - expected) < tolerance * expected


def _fits(row: ObjectRow, size: float, tolerance: float) -> bool:
    """Whether the row means an object of this diameter; a row without one means any."""
    return row.diameter == 0.0 or _near(size, row.diameter, tolerance)


def _checked_hull_volume(raw: RawObject, origin: str, config: Config) -> float:
    """Volume of the convex hull [m³] of an object whose size and place are fit for the tote."""
    volume = hull_volume(raw.mesh.vertices)
    if volume == 0.0:
        raise CatalogError(f"{origin}: all vertices lie in one plane; a body needs a volume")
    size = diameter(raw.mesh.vertices)
    if size < _LEAST_DIAMETER:
        raise CatalogError(f"{origin}: diameter {size:.4g} m; a body needs at least {_LEAST_DIAMETER:g} m; {_UNITS}")
    _check_room(raw.mesh.vertices, size, origin, config.tote)
    radius = float(np.linalg.norm(raw.mesh.vertices, axis=1).max())
    if radius > _FARTHEST_ORIGIN * size:
        raise CatalogError(
            f"{origin}: a vertex lies {radius:.4g} m from the origin, but the body's diameter is {size:.4g} m; move the mesh to its origin"
        )
    return volume


def _check_room(vertices: np.ndarray, size: float, origin: str, tote: Tote) -> None:
    """Refuse an object of this diameter [m] that cannot lie in the tote, or cannot pass its opening upright, in any pose.

    It passes if the two smaller sides of a box about it are no longer than the opening's. The box along the object's own axes is tried
    first, since the least box takes long to find for fine meshes.
    """
    inside = float(np.linalg.norm((*tote.rim_size, tote.outer_size[2] - tote.wall)))
    opening = sorted(tote.rim_size)
    box = sorted(np.ptp(vertices, axis=0).tolist())
    if size <= inside and box[0] <= opening[0] and box[1] <= opening[1]:
        return
    box = sorted(oriented_bounds(vertices)[1].tolist())
    if size <= inside and box[0] <= opening[0] and box[1] <= opening[1]:
        return
    raise CatalogError(
        f"{origin}: too large for the tote: {_by(box)} m, {size:.4g} m from end to end, but the tote's opening is {_by(opening)} m, "
        f"and {inside:.3g} m the longest way through it; {_UNITS}"
    )


def _by(sides: list[float]) -> str:
    return " x ".join(f"{side:.3g}" for side in sides)


def _checked_mass(raw: RawObject, hull: float, origin: str, config: Config) -> float:
    """Mass [kg]: the object's own, or by the density over its hull's volume [m³]."""
    mass = config.objects.density * hull if raw.mass is None else raw.mass
    if not _MASSES[0] <= mass <= _MASSES[1]:
        source = "by objects.density" if raw.mass is None else "in its row of the object table"
        raise CatalogError(f"{origin}: mass {mass:g} kg {source}; allowed: {_MASSES[0]:g} to {_MASSES[1]:g} kg")
    return mass


def _report_never_drawn(entries: list[CatalogEntry], budget: float, report: Callable[[str], None]) -> None:
    """Name the objects that alone exceed the volume budget [m³]. That all of them do is a mistake, found when slots are counted."""
    never = [entry for entry in entries if entry.volume > budget]
    if never and len(never) < len(entries):
        names = ", ".join(f"{entry.name} ({entry.volume:.3g} m³)" for entry in never)
        report(f"never drawn, since larger than arrangement.volume, {budget:g} m³: {names}")


def _recipe(raw: RawObject, hull: float, objects: Objects) -> ShapeRecipe:
    concave = raw.concave
    if concave is None:
        concave = signed_volume(raw.mesh.vertices, raw.mesh.faces) < objects.concave_ratio * hull
    return ShapeRecipe(concave, objects.hull_vertices, objects.piece_vertices, objects.pieces, objects.concavity)


def _entry(raw: RawObject, pieces: tuple[ConvexPiece, ...], mass: float) -> CatalogEntry:
    properties = mass_properties(pieces)
    return CatalogEntry(
        obj_id=raw.obj_id,
        name=raw.name,
        mesh=raw.mesh,
        material=raw.material,
        pieces=pieces,
        volume=properties.volume,
        radius=float(np.linalg.norm(raw.mesh.vertices, axis=1).max()),
        mass=mass,
        center_of_mass=properties.center_of_mass,
        inertia=mass * properties.unit_inertia,
        diameter=diameter(raw.mesh.vertices),
        symmetries_discrete=raw.symmetries_discrete,
        symmetries_continuous=raw.symmetries_continuous,
        source=raw.source,
    )
