"""The object catalog of a bake: models from a folder or the embedded ones, validated, with collision shapes and mass properties; and a
cache of detected symmetries in the user's cache folder.

The cache's key is a hash of the mesh, the tolerance and the source code of the detection: symmetries of a part are detected once, and again
after the code has changed.
"""

import contextlib
import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy
from trimesh.bounds import oriented_bounds

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.episodes.objects import AUTO_UNIT, HULL, MASS_RANGE, MESH, UNITS
from synpick_warp.configs.schema import Config, ObjectRow, Objects
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import FileMaterial
from synpick_warp.scenes.assets.asset_files import asset_scope, ignore, list_names, read_isolated
from synpick_warp.scenes.assets.meshes import STEP_SUFFIXES, MeshOptions, connected_parts, merge_positions, read_mesh, solid_volume
from synpick_warp.scenes.assets.model_folders import ModelFile, list_models
from synpick_warp.scenes.assets.models_info import FileModelInfo, check_against_mesh, read_models_info
from synpick_warp.scenes.collision.hulls import hull_size, is_concave, mass_properties
from synpick_warp.scenes.collision.shapes import ShapeRecipe, collision_shapes, default_cache_dir, write_arrays
from synpick_warp.scenes.embedded.objects import procedural_objects, solids
from synpick_warp.scenes.props import make_props
from synpick_warp.scenes.symmetries import detection, surface
from synpick_warp.scenes.symmetries.detection import Symmetries, Turn, add_symmetries, find_symmetries
from synpick_warp.scenes.symmetries.surface import look_alike, shape_profile
from synpick_warp.scenes.types import FIRST_DISTRACTOR, Catalog, CatalogEntry, ConvexPiece, HullSize, RawObject, TriangleMesh
from synpick_warp.system import linear_algebra
from synpick_warp.system.hardware.kernels import user_cache
from synpick_warp.system.inputs.files import check_regular_file
from synpick_warp.system.linear_algebra import norm
from synpick_warp.system.processes.isolation import Limits

MAX_FILE = 1 << 22
"""Largest file that is read [bytes]: 20,000 symmetries, more than an object can have."""


def cached_symmetries(vertices: np.ndarray, faces: np.ndarray, diameter: float, tolerance: float, folder: Path | None = None) -> Symmetries:
    """Symmetries of a mesh by `find_symmetries`, or those that it found before. `folder`: cache folder, which need not exist nor be
    writable; None: that of the user."""
    given = (diameter, tolerance, vertices.shape, vertices.dtype, faces.shape, faces.dtype, np.__version__, scipy.__version__)
    digest = hashlib.sha256(repr(given).encode())
    for part in (*(Path(str(module.__file__)).read_bytes() for module in (detection, surface, linear_algebra)), vertices, faces):
        digest.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    file = (folder or (user_cache() or Path(os.devnull)) / "synpick-warp" / "symmetries") / f"{digest.hexdigest()}.npz"
    with contextlib.suppress(Exception):  # A damaged file raises nearly anything; whatever it is, the symmetries are found again.
        check_regular_file(file, MAX_FILE, CatalogError)
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            turns = [Turn(row[:3], row[3:6], int(row[6]), float(row[7])) for row in data["turns"].reshape(-1, 8)]
            continuous, missed = turns[: int(data["continuous"])], turns[int(data["continuous"]) :]
            return Symmetries(data["discrete"].reshape(-1, 4, 4), data["deviations"], tuple(continuous), missed[0] if missed else None)
    found = find_symmetries(vertices, faces, diameter, tolerance)
    with contextlib.suppress(OSError):  # Without a cache they are found each time.
        turns = [*found.continuous, *([] if found.missed is None else [found.missed])]
        rows = np.array([(*turn.axis, *turn.point, turn.fold, turn.deviation) for turn in turns], np.float64)
        count = np.array(len(found.continuous))
        write_arrays(file, turns=rows, continuous=count, discrete=found.discrete, deviations=found.deviations)
    return found


# Minimum diameter [m]: smaller bodies vanish in the contact margin, and come from files in another unit than expected.
_MIN_DIAMETER = 2e-3
# Maximum distance of a vertex from the origin, in diameters: with more, the origin lies far outside the body, and the bounding sphere
# about the origin (which spaces the drop) would be mostly empty.
_MAX_ORIGIN_DISTANCE = 1.5
# Pieces that make up at most this part of a mesh's surface, and shorten it to this part of its length if they are left out, are told.
_SPECK, _LENGTHENED = 0.01, 0.95
# Part of its hull's volume above which a mesh has bodies that overlap; the rest is rounding.
_OVERFULL = 1.001
READ_LIMITS = Limits(600.0, 2**33)
"""Limits of a mesh file with its textures: 10 min and 8 GiB; the largest files that are read take a minute and 3 GiB."""
_UNITS = "files named obj_NNNNNN.ply are read in millimetres, all others in metres, unless objects.unit says otherwise"
# Median diameters below this [m], or beyond the tote's diagonal, are told as implausible; the metric unit in which the median is nearest to
# the typical diameter [m] of parts in a bin is proposed (inches are seldom, and near to centimetres).
_SMALL, _TYPICAL = 5e-3, 0.1


def load_catalog(config: Config, cache_dir: Path | None = None, report: Callable[[str], None] = ignore) -> Catalog:
    """Load the object catalog.

    `bake.models` is a BOP model folder (obj_NNNNNN.ply in millimetres, models_info.json), a folder of meshes in metres, which get obj_ids
    from 1 in the order of their file names, or a folder of such folders. If it is empty: the embedded objects. Objects that cannot be used
    are left out, with a line each; with `objects.strict`, the first of them is an error. Files are read in isolated processes; one for
    which time or memory of this machine does not suffice is an error, as elsewhere the same settings would give another catalog. `config`:
    settings: bake.models, objects, object_rows, bins, arrangement.volume, distractors of randomize. `cache_dir`: folder in which collision
    shapes are cached; None: `default_cache_dir()`.

    Raises CatalogError: the folder cannot be used, or none of its objects: a file is damaged, an object does not fit into the tote or has
    an invalid mass. Or time or memory does not suffice for a file."""
    rules = _Rules(config.objects, config.object_rows, config.cell.bins, config.randomize.surfaces)
    entries = _load_entries(config.bake.models, rules, cache_dir, report)
    if not config.arrangement.counts:
        _report_undrawable(entries, config.arrangement.volume, report)
    props = make_props(config.prop, config.cell.bins, report)
    if not config.randomize.most_distractors:
        return Catalog(tuple(entries), props=props)
    others = _load_entries(config.randomize.distractor_models, rules, cache_dir, report, entries)
    return Catalog(tuple(entries), tuple(replace(entry, obj_id=FIRST_DISTRACTOR - index) for index, entry in enumerate(others)), props)


def _load_entries(
    folder: str, rules: "_Rules", cache_dir: Path | None, report: Callable[[str], None], catalog: Sequence[CatalogEntry] = ()
) -> list[CatalogEntry]:
    """Load the objects of `_read_objects`, ordered by obj_id."""
    objects = rules.objects
    faults = _Faults(objects.strict, folder, report)
    raws = _read_objects(folder, rules, report, faults, catalog)
    recipes = [shape_recipe(raw, objects) for raw in raws]
    names, meshes = [raw.name for raw in raws], [raw.mesh for raw in raws]
    seconds = objects.decomposition_time
    shapes = collision_shapes(names, meshes, recipes, cache_dir or default_cache_dir(), report, seconds)
    entries, masses = [], []
    for raw, shape in zip(raws, shapes, strict=True):
        if isinstance(shape, CatalogError):
            faults.add(shape)
        else:
            masses.append((raw, _checked_mass(raw, objects, shape)))
            entries.append(_entry(raw, shape, masses[-1][1]))
    if not entries:
        raise faults.summary()
    faults.tell()
    if line := describe_masses([raw for raw, _ in masses], objects, [mass for _, mass in masses], guesses=True):
        report(line)
    return sorted(entries, key=lambda entry: entry.obj_id)


def read_objects(
    models: str, objects: Objects, rows: tuple[ObjectRow, ...], bins: tuple[BinSizes, ...], report: Callable[[str], None] = ignore
) -> list[RawObject]:
    """Read and check a folder's objects, or the embedded ones, without collision shapes; files and errors as of `load_catalog`."""
    faults = _Faults(objects.strict, models, report)
    raws = _read_objects(models, _Rules(objects, rows, bins), report, faults)
    faults.tell()
    return raws


def _read_objects(
    folder: str, rules: "_Rules", report: Callable[[str], None], faults: "_Faults", catalog: Sequence[CatalogEntry] = ()
) -> list[RawObject]:
    """The objects of a folder but for those that look like one of `catalog`; empty: the embedded ones, beside a `catalog` solids."""
    if not folder:
        return _embedded_objects(rules, faults, bool(catalog))
    raws = _read_folder(Path(folder).expanduser(), rules, report, faults)
    labelled = [(entry.name, shape_profile(entry.mesh.vertices, entry.mesh.faces)) for entry in catalog]
    for raw in [*raws] if labelled else ():
        profile = shape_profile(raw.mesh.vertices, raw.mesh.faces)
        twin = next((name for name, known in labelled if name == raw.name or look_alike(profile, known)), None)
        if twin is not None:
            faults.add(CatalogError(f"the distractor {raw.name}: it looks like {twin}, whose instances are labelled"))
            raws.remove(raw)
    if not raws:
        raise faults.summary()
    return raws


class _SizeError(CatalogError):
    """An object is too small or too large; `size` is its diameter [m]."""

    def __init__(self, message: str, size: float = 0.0) -> None:
        super().__init__(message)
        self.size = size


class _Faults:
    """Objects that cannot be used: with `objects.strict`, or if there is no other object, the first one is an error."""

    def __init__(self, strict: bool, folder: str, report: Callable[[str], None]) -> None:
        self._strict, self._folder, self._report = strict, folder, report
        self._errors: list[CatalogError] = []
        self.advice = ""
        """What may be wrong with all objects together."""

    def add(self, error: CatalogError) -> None:
        """Collect the error of an object, or raise it if `objects.strict` is set."""
        if self._strict:
            raise self._advised(error)
        self._errors.append(error)

    def tell(self) -> None:
        """Print a line for each object that is left out, and the advice."""
        for error in self._errors:
            self._report(f"left out: {error}")
        if self.advice:
            self._report(f"models folder {self._folder}: {self.advice}")

    def _advised(self, error: CatalogError) -> CatalogError:
        """Error with the advice behind its message."""
        return CatalogError(f"{error}; {self.advice}") if self.advice else error

    def summary(self) -> CatalogError:
        """Return the error for a folder without a usable object: that of its only object, or the number of objects and the first error."""
        count, first = len(self._errors), self._errors[0]
        if count > 1:
            folder = f"models folder {self._folder}" if self._folder else "the embedded objects"
            first = CatalogError(f"{folder}: none of its {count} objects can be used; the first: {first}")
        return self._advised(first)


@dataclass(frozen=True)
class _Rules:
    """Settings by which a model is read or made, and checked: objects, rows of the object table, bins, textures."""

    objects: Objects
    rows: tuple[ObjectRow, ...]
    bins: tuple[BinSizes, ...]
    surfaces: int = 0
    """Procedural textures; with some, geometric solids are textured."""


def _read_folder(folder: Path, rules: _Rules, report: Callable[[str], None], faults: _Faults) -> list[RawObject]:
    """Read all models of a folder, ordered by obj_id."""
    models = list_models(folder, report, faults.add)
    infos: dict[int, FileModelInfo] = {}
    if models and models[0].is_bop:

        def without(error: CatalogError) -> None:
            if rules.objects.strict:
                raise error
            report(f"{error}; until then it has no symmetries")

        infos = read_models_info(folder / "models_info.json", [model.obj_id for model in models], without)
    calls = [(model, infos.get(model.obj_id, FileModelInfo()), rules) for model in models]
    raws, sizes = [], []
    smaller = "decimate its mesh and scale down its textures, or remove the file"
    results = read_isolated(_read_model, calls, READ_LIMITS, CatalogError, smaller, "repair or simplify the file")
    for model, result in zip(models, results, strict=True):
        if isinstance(result, _SizeError | tuple) and model.path.suffix.lower() not in STEP_SUFFIXES:
            sizes.append(result.size if isinstance(result, _SizeError) else result[0].hull.diameter)
            faults.advice = _advise_unit(sizes, _unit(rules.objects, model), rules.bins[0])
        if isinstance(result, CatalogError):
            faults.add(result)
        else:
            raw, lines = result
            for line in lines:
                report(line)
            raws.append(raw)
    if not raws:
        raise faults.summary()
    return raws


def _embedded_objects(rules: _Rules, faults: _Faults, distractors: bool) -> list[RawObject]:
    """Embedded objects that fit into the bins; as distractors geometric solids, with procedural surfaces textured.

    Household objects are excluded, since they resemble labelled objects.
    """
    raws = []
    for raw in solids(rules.surfaces > 0) if distractors else procedural_objects(rules.objects.embedded):
        try:
            _check_size(raw, raw.name, rules.bins)
        except CatalogError as error:
            faults.add(error)
        else:
            raws.append(raw)
    if not raws:
        raise faults.summary()
    return raws


def _read_model(model: ModelFile, info: FileModelInfo, rules: _Rules) -> tuple[RawObject, list[str]]:
    """Read and check a model; returns it with lines on what was corrected. Runs in an isolated process.

    A BOP model has the row of the object table with its obj_id, others the row with their name, if the diameter agrees.
    """
    lines: list[str] = []
    objects = rules.objects
    unit, center = _unit(objects, model), objects.center and not model.is_bop
    options = MeshOptions(objects.crease_angle, center, not objects.strict, unit if center or objects.unit != AUTO_UNIT else "")
    with asset_scope(model.root) as scope:
        found = read_mesh(model.path, UNITS[unit], options, lines.append)
    mesh = found.mesh
    hull, tolerance = hull_size(mesh.vertices), objects.diameter_tolerance
    if model.is_bop and hull.diameter > 0.0:
        info, said = _check_info(info, mesh, hull, model, objects.strict)
        lines += said
    rows = (row for row in rules.rows if (row.id == model.obj_id if model.is_bop else row.name == model.name))
    # A row without a diameter applies to any object.
    row = next((row for row in rows if not row.diameter or abs(hull.diameter - row.diameter) < tolerance * row.diameter), None)
    raw = _raw(model, mesh, hull, found.material, row, objects)
    lines += _describe_specks(mesh, hull.diameter, str(model.path))
    _check_size(raw, str(model.path if model.is_bop else raw.name), rules.bins)
    info, said = add_symmetries(info, found, hull.diameter, row, objects, str(model.path), cached_symmetries)
    lines += said
    raw = replace(raw, symmetries_discrete=info.symmetries_discrete, symmetries_continuous=info.symmetries_continuous)
    # A copy of the file could not name its texture as it does, and would have another unit than BOP's.
    if model.is_bop and unit == "mm" and not scope.moved:
        raw = replace(raw, source=model.path)
    _checked_mass(raw, objects)
    return raw, [*scope.moved[:1], *lines]


def _unit(objects: Objects, model: ModelFile) -> str:
    return objects.unit if objects.unit != AUTO_UNIT else "mm" if model.is_bop else "m"


def _advise_unit(sizes: list[float], unit: str, place: BinSizes) -> str:
    """Advice if the median diameter [m] of objects that were read in a unit is implausible, and is not in another unit; else empty."""
    median = float(np.median(sizes)) if sizes else _TYPICAL
    if _SMALL <= median <= _inner_diagonal(place):
        return ""
    likely = min(("m", "cm", "mm"), key=lambda name: abs(np.log(max(median, 1e-30) / UNITS[unit] * UNITS[name] / _TYPICAL)))
    if likely == unit:
        return ""
    shown = f"{median:.3g} m" if median >= 1.0 else f"{median / UNITS['mm']:.3g} mm"
    return f'{"median " if len(sizes) > 1 else ""}size {shown}: did you mean objects.unit = "{likely}"?'


def _check_info(info: FileModelInfo, mesh: TriangleMesh, hull: HullSize, model: ModelFile, strict: bool) -> tuple[FileModelInfo, list[str]]:
    """Compare a model with its entry in models_info.json; returns the corrected entry, and a line if it was wrong."""
    try:
        info, said = check_against_mesh(info, mesh.vertices, hull.diameter)
    except CatalogError as error:
        raise CatalogError(f"{model.path}: {error}") from error
    line = f"{model.path}: models_info.json gives {'; '.join(said)}"
    if said and strict:
        raise CatalogError(line)
    return info, [line] if said else []


def _raw(model: ModelFile, mesh: TriangleMesh, hull: HullSize, given: FileMaterial, row: ObjectRow | None, objects: Objects) -> RawObject:
    """Combine mesh file and row. Material properties of the file have priority over the row, the row over the section objects."""
    defaults = row or objects
    concave = row.concave if row else None
    return RawObject(
        obj_id=model.obj_id,
        name=row.name if row and row.name else model.name,
        mesh=mesh,
        hull=hull,
        material=given.complete(defaults.metallic, defaults.roughness),
        mass=row.mass if row else None,
        concave=is_concave(mesh.vertices, mesh.faces, hull.volume, objects.concave_ratio) if concave is None else concave,
        symmetries_discrete=(),
        symmetries_continuous=(),
        source=None,
    )


def _check_size(raw: RawObject, origin: str, bins: Sequence[BinSizes]) -> None:
    """Refuse an object that is flat, too small, too large for the tote, or far from its origin."""
    if raw.hull.volume == 0.0:
        raise CatalogError(f"{origin}: all vertices lie in one plane; a body needs a volume")
    size = raw.hull.diameter
    if size < _MIN_DIAMETER:
        raise _SizeError(f"{origin}: diameter {size:.4g} m; a body needs at least {_MIN_DIAMETER:g} m; {_UNITS}", size)
    for sizes in bins:
        _check_fits_bin(raw.mesh.vertices, size, origin, sizes)
    radius = float(np.linalg.norm(raw.mesh.vertices, axis=1).max())
    if radius > _MAX_ORIGIN_DISTANCE * size:
        raise CatalogError(
            f"{origin}: a vertex lies {radius:.4g} m from the origin, but the body's diameter is {size:.4g} m; centre it "
            "on its origin, or set objects.center = true"
        )


def _check_fits_bin(vertices: np.ndarray, size: float, origin: str, sizes: BinSizes) -> None:
    """Refuse an object of this diameter [m] that passes through a bin's opening in no orientation, or does not fit into the bin.

    It passes if the two smaller sides of a bounding box are at most as long as the opening's. The axis-aligned box is tried first, since
    the minimum oriented bounding box takes long to compute for fine meshes.
    """
    inside = _inner_diagonal(sizes) if sizes.shell else np.inf
    opening = sorted(sizes.mouth)
    box = sorted(np.ptp(vertices, axis=0).tolist())
    if size <= inside and box[0] <= opening[0] and box[1] <= opening[1]:
        return
    box = sorted(oriented_bounds(vertices)[1].tolist())
    if size <= inside and box[0] <= opening[0] and box[1] <= opening[1]:
        return
    raise _SizeError(
        f"{origin}: too large for the {sizes.noun}: {_by(box)} m, diameter {size:.4g} m, but the {sizes.noun}'s opening is "
        f"{_by(opening)} m, and its inner diagonal {inside:.3g} m; {_UNITS}",
        size,
    )


def _inner_diagonal(sizes: BinSizes) -> float:
    """Diagonal of a bin's inside, or of the area where objects are dropped [m]."""
    return float(norm(np.array((*sizes.mouth, sizes.height))))


def _by(sides: list[float]) -> str:
    """Text of the sides of a box, such as "1 x 2 x 3", for messages."""
    return " x ".join(f"{side:.3g}" for side in sides)


def _describe_specks(mesh: TriangleMesh, diameter: float, origin: str) -> list[str]:
    """Line on loose pieces of a mesh, a hundredth of its surface in all, that lie so far off that they lengthen it."""
    positions, faces = merge_positions(mesh.vertices, mesh.faces)
    part = connected_parts(faces)[faces[:, 0]]
    corners = positions[faces]
    area = np.bincount(part, np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))
    order = np.argsort(area, kind="stable")
    loose = np.zeros(len(area), bool)
    loose[order[np.cumsum(area[order]) <= _SPECK * area.sum()]] = True
    size = hull_size(corners[~loose[part]].reshape(-1, 3)).diameter if loose.any() else diameter
    if size >= _LENGTHENED * diameter:
        return []
    said = f"{origin}: loose pieces, {int(loose[part].sum())} of its {len(faces)} triangles, lengthen it"
    return [f"{said} from {1e3 * size:.4g} to {1e3 * diameter:.4g} mm; delete them from the file unless they belong to it"]


def describe_masses(raws: Sequence[RawObject], objects: Objects, masses: Sequence[float] = (), *, guesses: bool = False) -> str:
    """Line on masses [kg] that follow from densities; empty: there are none. `masses`: their masses, if their collision shapes are known.
    `guesses`: those whose mesh is open or whose density is not known; otherwise those of which both are known, or not the density."""
    known = objects.mass_volume == MESH and objects.density != Objects.density
    pairs = zip(raws, masses or [_checked_mass(raw, objects) for raw in raws], strict=True)
    told = {raw.name: mass for raw, mass in pairs if raw.mass is None and not (known and bool(_solid(raw)) == guesses)}
    if not told:
        return ""
    low, high = (f"{pick(told.values()):.3g}" for pick in (min, max))
    what = "convex hulls" if objects.mass_volume == HULL else "collision shapes, where meshes are open" if guesses and known else "meshes"
    line = f"mass of {list_names(told)}: {low if low == high else f'{low} to {high}'} kg, {objects.density:g} kg/m³ of their {what}"
    advice = (
        "close the meshes, or set mass in [[object_rows]]" if known else "set objects.density to the material's, or mass in [[object_rows]]"
    )
    return f"{line}, is a guess; {advice}" if guesses or not known else line


def _solid(raw: RawObject) -> float:
    """Volume that the object's mesh encloses [m³]; 0: it is open, or bodies in it overlap."""
    volume = solid_volume(raw.mesh.vertices, raw.mesh.faces) or 0.0
    return volume if volume <= _OVERFULL * raw.hull.volume else 0.0


def _checked_mass(raw: RawObject, objects: Objects, pieces: Sequence[ConvexPiece] = ()) -> float:
    """Mass [kg]: the object's own, or density times the volume of `objects.mass_volume`; before there are pieces, that of the hull."""
    origin = raw.source or raw.name
    mass = raw.mass
    if mass is None:
        solid = _solid(raw) if objects.mass_volume == MESH else raw.hull.volume
        mass = objects.density * (solid or (mass_properties(pieces).volume if pieces else raw.hull.volume))
    if not MASS_RANGE[0] <= mass <= MASS_RANGE[1]:
        source = "by objects.density" if raw.mass is None else "in its row of the object table"
        raise CatalogError(f"{origin}: mass {mass:g} kg {source}; allowed: {MASS_RANGE[0]:g} to {MASS_RANGE[1]:g} kg")
    return mass


def _report_undrawable(entries: list[CatalogEntry], budget: float, report: Callable[[str], None]) -> None:
    """Report objects that alone exceed the volume budget [m³]. If all do, counting slots raises an error."""
    excluded = [entry for entry in entries if entry.volume > budget]
    if excluded and len(excluded) < len(entries):
        names = ", ".join(f"{entry.name} ({entry.volume:.3g} m³)" for entry in excluded)
        report(f"never drawn, since larger than arrangement.volume, {budget:g} m³: {names}")


def shape_recipe(raw: RawObject, objects: Objects) -> ShapeRecipe:
    """Parameters of an object's collision shape."""
    return ShapeRecipe(raw.concave, objects.hull_vertices, objects.piece_vertices, objects.pieces, objects.concavity)


def _entry(raw: RawObject, pieces: tuple[ConvexPiece, ...], mass: float) -> CatalogEntry:
    """Build the catalog entry of an object from its collision shape and mass."""
    properties = mass_properties(pieces)
    names = ("obj_id", "name", "mesh", "material", "symmetries_discrete", "symmetries_continuous", "source")
    return CatalogEntry(
        **{name: getattr(raw, name) for name in names},
        pieces=pieces,
        volume=properties.volume,
        radius=float(np.linalg.norm(raw.mesh.vertices, axis=1).max()),
        mass=mass,
        center_of_mass=properties.center_of_mass,
        inertia=mass * properties.unit_inertia,
        diameter=raw.hull.diameter,
    )
