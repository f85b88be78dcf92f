"""The object catalog of a bake: models from a folder or the embedded ones, validated, with collision shapes and mass properties."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from trimesh.bounds import oriented_bounds

from synpick_warp.configs.schema import Config, ObjectRow, Objects, Tote
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import FileMaterial
from synpick_warp.scenes.assets.asset_files import check_file_name
from synpick_warp.scenes.assets.meshes import SUFFIXES, MeshOptions, read_mesh, signed_volume
from synpick_warp.scenes.assets.models_info import ModelInfo, bop_files, read_models_info
from synpick_warp.scenes.collision.decomposition import ShapeRecipe
from synpick_warp.scenes.collision.hulls import hull_size, mass_properties
from synpick_warp.scenes.collision.shapes import collision_shapes, default_cache_dir
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.types import Catalog, CatalogEntry, ConvexPiece, HullSize, Material, RawObject, TriangleMesh
from synpick_warp.system.threads import map_in_threads

_MILLIMETRE = 1e-3
# Minimum diameter [m]: smaller bodies vanish in the contact margin, and come from files in another unit than expected.
_MIN_DIAMETER = 2e-3
# Maximum distance of a vertex from the origin, in diameters: with more, the origin lies far outside the body, and the bounding sphere
# about the origin (which spaces the drop) would be mostly empty.
_MAX_ORIGIN_DISTANCE = 1.5
# Allowed masses [kg]: others have no useful inverse in 32-bit floats.
_MASS_RANGE = (1e-7, 1e4)
_UNITS = "files named obj_NNNNNN.ply are read in millimetres, all others in metres"


def _ignore(line: str) -> None:
    """Default for `report`."""


def load_catalog(config: Config, cache_dir: Path | None = None, report: Callable[[str], None] = _ignore) -> Catalog:
    """Load the object catalog.

    `bake.models` is a BOP model folder (obj_NNNNNN.ply in millimetres, models_info.json), or a folder of .ply, .obj and .glb meshes in
    metres, which get obj_ids from 1 in the order of their file names. If it is empty: the embedded objects.

    Args:
        config: Settings: bake.models, objects, object_rows, tote, arrangement.volume.
        cache_dir: Folder in which collision shapes are cached; None: `default_cache_dir()`.
        report: Called with each line of progress.

    Raises:
        CatalogError: The folder or one of its files cannot be used, or an object does not fit into the tote or has an invalid mass.
    """
    folder = Path(config.bake.models).expanduser()
    raws = _read_folder(folder, config, report) if config.bake.models else procedural_objects()
    origins = [str(raw.source or raw.name) for raw in raws]
    for raw, origin in zip(raws, origins, strict=True):
        _check_size(raw, origin, config.tote)
    masses = [_checked_mass(raw, origin, config) for raw, origin in zip(raws, origins, strict=True)]
    recipes = [_recipe(raw, config.objects) for raw in raws]
    shapes = collision_shapes([raw.name for raw in raws], [raw.mesh for raw in raws], recipes, cache_dir or default_cache_dir(), report)
    entries = [_entry(raw, pieces, mass) for raw, pieces, mass in zip(raws, shapes, masses, strict=True)]
    _report_undrawable(entries, config.arrangement.volume, report)
    return Catalog(tuple(sorted(entries, key=lambda entry: entry.obj_id)))


def _read_folder(folder: Path, config: Config, report: Callable[[str], None]) -> list[RawObject]:
    """Read all models of a folder, ordered by obj_id."""
    if not folder.is_dir():
        raise CatalogError(f"models folder {folder}: no such folder; give a BOP model folder, or a folder of OBJ, GLB or PLY meshes")
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
    except OSError as error:
        raise CatalogError(f"models folder {folder}: cannot be listed ({error.strerror})") from error
    if not files:
        raise CatalogError(f"models folder {folder}: it contains no models; add obj_NNNNNN.ply files, or .obj, .glb or .ply meshes")
    models = bop_files(files)
    for file in models.values() if models else files:
        check_file_name(file, CatalogError)
    if models:
        if ignored := len(files) - len(models):
            report(f"models folder {folder}: {ignored} meshes that are not named obj_NNNNNN.ply are ignored")
        infos = read_models_info(folder / "models_info.json", models)
        return _read_all(lambda item, said: _read_bop(*item, infos.get(item[0], ModelInfo()), config, said), sorted(models.items()), report)
    for first, second in itertools.pairwise(files):
        if first.stem == second.stem:
            raise CatalogError(f"models folder {folder}: {first.name} and {second.name} have the same name; keep one of them")
    return _read_all(lambda item, said: _read_own(*item, config, said), list(enumerate(files, 1)), report)


def _read_all(
    read: Callable[[tuple[int, Path], Callable[[str], None]], RawObject], items: list[tuple[int, Path]], report: Callable[[str], None]
) -> list[RawObject]:
    """Read files in threads, and report what their readers say in the order of the files."""
    said: dict[tuple[int, Path], list[str]] = {item: [] for item in items}
    objects = map_in_threads(lambda item: read(item, said[item].append), items)
    for line in itertools.chain.from_iterable(said.values()):
        report(line)
    return objects


def _read_bop(obj_id: int, file: Path, info: ModelInfo, config: Config, say: Callable[[str], None]) -> RawObject:
    """Read a model of a BOP folder, with the row of the object table that has its obj_id, if the diameter agrees."""
    mesh, material = read_mesh(file, _MILLIMETRE, MeshOptions(config.objects.crease_angle), say)
    hull = hull_size(mesh.vertices)
    size = hull.diameter
    tolerance = config.objects.diameter_tolerance
    if info.diameter is not None and size > 0.0 and not _near(size, info.diameter, tolerance):
        raise CatalogError(
            f"{file}: diameter {size * 1e3:.4g} mm, but models_info.json says {info.diameter * 1e3:.4g}; both must be in millimetres"
        )
    row = next((row for row in config.object_rows if row.id == obj_id and _fits(row, size, tolerance)), None)
    raw = _raw(obj_id, file, mesh, hull, material, row, config.objects)
    return replace(raw, symmetries_discrete=info.symmetries_discrete, symmetries_continuous=info.symmetries_continuous, source=file)


def _read_own(obj_id: int, file: Path, config: Config, say: Callable[[str], None]) -> RawObject:
    """Read a mesh that is not a BOP model. Its obj_id is its position, so rows of the object table are matched by name and diameter."""
    mesh, material = read_mesh(file, 1.0, MeshOptions(config.objects.crease_angle, config.objects.center), say)
    hull, tolerance = hull_size(mesh.vertices), config.objects.diameter_tolerance
    row = next((row for row in config.object_rows if row.name == file.stem and _fits(row, hull.diameter, tolerance)), None)
    return _raw(obj_id, file, mesh, hull, material, row, config.objects)


def _raw(
    obj_id: int, file: Path, mesh: TriangleMesh, hull: HullSize, given: FileMaterial, row: ObjectRow | None, objects: Objects
) -> RawObject:
    """Combine mesh file and row. Material properties of the file have priority over the row, the row over the section objects."""
    defaults = row or objects
    material = Material(
        given.color,
        given.texture,
        defaults.metallic if given.metallic is None else given.metallic,
        defaults.roughness if given.roughness is None else given.roughness,
    )
    return RawObject(
        obj_id=obj_id,
        name=row.name if row and row.name else file.stem,
        mesh=mesh,
        hull=hull,
        material=material,
        mass=row.mass if row else None,
        concave=row.concave if row else None,
        symmetries_discrete=(),
        symmetries_continuous=(),
        source=None,
    )


def _near(value: float, expected: float, tolerance: float) -> bool:
    return abs(value - expected) < tolerance * expected


def _fits(row: ObjectRow, size: float, tolerance: float) -> bool:
    """Whether the row applies to an object of this diameter; a row without one applies to any."""
    return row.diameter == 0.0 or _near(size, row.diameter, tolerance)


def _check_size(raw: RawObject, origin: str, tote: Tote) -> None:
    """Refuse an object that is flat, too small, too large for the tote, or far from its origin."""
    if raw.hull.volume == 0.0:
        raise CatalogError(f"{origin}: all vertices lie in one plane; a body needs a volume")
    size = raw.hull.diameter
    if size < _MIN_DIAMETER:
        raise CatalogError(f"{origin}: diameter {size:.4g} m; a body needs at least {_MIN_DIAMETER:g} m; {_UNITS}")
    _check_fits_tote(raw.mesh.vertices, size, origin, tote)
    radius = float(np.linalg.norm(raw.mesh.vertices, axis=1).max())
    if radius > _MAX_ORIGIN_DISTANCE * size:
        raise CatalogError(
            f"{origin}: a vertex lies {radius:.4g} m from the origin, but the body's diameter is {size:.4g} m; centre it "
            "on its origin, or set objects.center = true"
        )


def _check_fits_tote(vertices: np.ndarray, size: float, origin: str, tote: Tote) -> None:
    """Refuse an object of this diameter [m] that passes through the tote's opening in no orientation, or does not fit into the tote.

    It passes if the two smaller sides of a bounding box are no longer than the opening's. The axis-aligned box is tried first, since the
    minimum oriented bounding box takes long to compute for fine meshes.
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
        f"{origin}: too large for the tote: {_by(box)} m, diameter {size:.4g} m, but the tote's opening is {_by(opening)} m, "
        f"and its inner diagonal {inside:.3g} m; {_UNITS}"
    )


def _by(sides: list[float]) -> str:
    return " x ".join(f"{side:.3g}" for side in sides)


def _checked_mass(raw: RawObject, origin: str, config: Config) -> float:
    """Mass [kg]: the object's own, or density times hull volume."""
    mass = config.objects.density * raw.hull.volume if raw.mass is None else raw.mass
    if not _MASS_RANGE[0] <= mass <= _MASS_RANGE[1]:
        source = "by objects.density" if raw.mass is None else "in its row of the object table"
        raise CatalogError(f"{origin}: mass {mass:g} kg {source}; allowed: {_MASS_RANGE[0]:g} to {_MASS_RANGE[1]:g} kg")
    return mass


def _report_undrawable(entries: list[CatalogEntry], budget: float, report: Callable[[str], None]) -> None:
    """Report objects that alone exceed the volume budget [m³]. If all do, counting slots raises an error."""
    excluded = [entry for entry in entries if entry.volume > budget]
    if excluded and len(excluded) < len(entries):
        names = ", ".join(f"{entry.name} ({entry.volume:.3g} m³)" for entry in excluded)
        report(f"never drawn, since larger than arrangement.volume, {budget:g} m³: {names}")


def _recipe(raw: RawObject, objects: Objects) -> ShapeRecipe:
    concave = raw.concave
    if concave is None:
        concave = signed_volume(raw.mesh.vertices, raw.mesh.faces) < objects.concave_ratio * raw.hull.volume
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
        diameter=raw.hull.diameter,
        symmetries_discrete=raw.symmetries_discrete,
        symmetries_continuous=raw.symmetries_continuous,
        source=raw.source,
    )
