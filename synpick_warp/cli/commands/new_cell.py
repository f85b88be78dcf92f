"""Command `new-cell`: a commented settings file of the user's cameras, bin and parts, with a picture of the cell."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from synpick_warp.cli.commands.pictures import draw_cell
from synpick_warp.cli.options import check_output_file, parse_resolution
from synpick_warp.configs.calibration.files import MAX_SIDE, MODELS, read_calibration
from synpick_warp.configs.cell.bins import AXES, BOX, COLLISIONS, BinRow, BinSizes
from synpick_warp.configs.cell.cameras import CameraRow, lens_map
from synpick_warp.configs.episodes.objects import AUTO_UNIT, DECLARED, DETECT, MASS_RANGE, MATERIALS, UNITS
from synpick_warp.configs.files.cell_file import NewCell, bin_of_size, cell_toml
from synpick_warp.configs.rules.camera_rules import NAME, RESERVED
from synpick_warp.configs.schema import Config
from synpick_warp.errors import CatalogError, ConfigError, OutputError, SynpickError, escape, format_value, suggest
from synpick_warp.scenes.bin_meshes.loading import load_settings
from synpick_warp.system.inputs.files import make_folder, read_file

if TYPE_CHECKING:
    from synpick_warp.scenes.types import RawObject
    from synpick_warp.system.progress import Progress

CELL, PICTURE, PARTS, BINS = "cell.toml", "cell.png", "parts", "bins"
_FOV, _RESOLUTION = 40.0, (640, 480)
"""Of cameras without a calibration file [°, px]."""
_SIZE = re.compile(r"([0-9.]{1,12})[xX]([0-9.]{1,12})[xX]([0-9.]{1,12}) ?(mm|cm|m|in)?")
_SIDES, _HEIGHTS = (0.08, 3.0), (0.03, 1.0)
"""Allowed lengths and widths, and heights, of a bin [m]."""
_OTHER_FILES = {".obj": rb"^\s*mtllib\s", ".gltf": rb'"uri"\s*:\s*"(?!data:)', ".ply": rb"^comment TextureFile "}
"""What shows that a mesh file names others."""
_PERCEPTION, _LEAST = 640, 16
"""Width of the image of perception [px], that of the preset smoke, whose other settings are in its pixels; and its least height."""
_DENSITIES = (10.0, 1e5)
"""Allowed densities [kg/m³]: foams have 10 at least; smaller numbers are in g/cm³."""
_OFF_CENTRE = 0.1
"""Distance of a bounding box's centre from the origin, by the box's diagonal, of which validate warns."""
_LONGEST = 28
"""Longest name of a camera, without a number behind it."""

BinOption = Annotated[
    str,
    Parameter(
        name="--bin",
        help="Outer size of the bin, LENGTHxWIDTHxHEIGHT in metres, or as 600x400x220mm; or its mesh file (STL, PLY, OBJ, glTF, STEP), "
        "which is copied unless it refers to other files.",
    ),
]
BinUnitOption = Annotated[
    str | None, Parameter(help=f"Unit of the bin's mesh file, whatever that of the parts: {', '.join(UNITS)} (default: m; bin.unit).")
]
BinUpOption = Annotated[str | None, Parameter(help=f"Axis of the bin's mesh file that points up: {', '.join(AXES)} (default: z; bin.up).")]
DensityOption = Annotated[
    str | None,
    Parameter(
        help="Density of the parts' material [kg/m³], times the volume of their meshes: a number, or "
        f"{', '.join(MATERIALS)} (default: their mass is guessed; objects.density)."
    ),
]
MassOption = Annotated[float | None, Parameter(help="Mass of each part [kg], in place of --density (object_rows.mass).")]
BinCollisionOption = Annotated[
    str | None,
    Parameter(help=f"What the bin's mesh collides as: mesh, or {BOX} for a basket of wire: a closed box (default: mesh; bin.collision)."),
]


def new_cell(
    folder: Annotated[Path, Parameter(name="DIR", help="Folder of the cell: new or empty.")],
    /,
    *,
    calibration: Annotated[
        list[Path] | None,
        Parameter(
            negative=(),
            help="Calibration file of a camera: OpenCV (YAML, XML, JSON), ROS camera_info, BOP camera.json, RealSense or Zivid; may be "
            "repeated, and names the camera (default: two cameras without distortion).",
        ),
    ] = None,
    bin_: BinOption = "0.6x0.4x0.2",
    bin_unit: BinUnitOption = None,
    bin_up: BinUpOption = None,
    bin_collision: BinCollisionOption = None,
    part: Annotated[
        list[Path] | None,
        Parameter(
            negative=(),
            help="Mesh file of a part (STL, PLY, OBJ, glTF, STEP), which is copied, or a folder of them, which is named; may be repeated "
            "for files (default: the embedded household objects).",
        ),
    ] = None,
    unit: Annotated[str | None, Parameter(help=f"Unit of the parts' files: {', '.join(UNITS)} (default: m; objects.unit).")] = None,
    density: DensityOption = None,
    mass: MassOption = None,
    resolution: Annotated[str | None, Parameter(help="Image size of cameras whose calibration does not say it, as WIDTHxHEIGHT.")] = None,
    lens: Annotated[
        str | None, Parameter(help=f"Distortion model of calibrations that do not name it: {' or '.join(MODELS)} (camera.model).")
    ] = None,
) -> int:
    """Write a commented cell.toml of your own cell, which bakes as it is, and a picture of it: a start to edit.

    The poses of the cameras are guesses from which they see the bin; replace them by measured ones.

    Exit codes: 0; 2, DIR is not empty, or a file or size cannot be used; then nothing is written.
    """
    place = Path(os.path.realpath(folder))
    _check_folder(folder, place)
    _check_parts(parts := part or [], {"--unit": unit, "--density": density, "--mass": mass})
    weights = _parse_density(density), _check_mass(mass, density)
    shape = _read_bin(bin_, bin_unit, bin_up, bin_collision)
    from synpick_warp.apps.viz.frusta import pose_for
    from synpick_warp.cli.display import make_console, make_progress

    with _staged(folder, place) as stage, make_progress(make_console()) as progress:
        copied = [file for file in parts if not file.is_dir()]
        for file in copied:
            _copy(file, stage / PARTS)
        models = os.path.realpath(parts[0]) if parts and not copied else PARTS if parts else ""
        rows, sizes = _read_cameras(calibration or [], resolution, lens or "", stage), BinSizes.of_row(shape)
        cameras = [{"name": row.name, **given, "pose": pose_for(row, index, sizes)} for index, (row, given) in enumerate(rows)]
        width, height = rows[0][0].resolution or _RESOLUTION
        perception = (_PERCEPTION, min(max(_LEAST, round(_PERCEPTION * height / width)), MAX_SIDE))
        cell = NewCell(cameras, _copy_bin(shape, stage), models, unit or AUTO_UNIT, *weights, perception=perception)
        _fill(cell, folder, stage, progress, calibration or [], f"{place.name}/{CELL}")
    bake = f"synpick-warp bake --config {shlex.quote(escape(str(folder / CELL)))} --out DATA"
    print(f"cell: {escape(str(folder / CELL))}, picture: {escape(str(folder / PICTURE))}\nbake it: {bake}")
    return 0


def _fill(cell: NewCell, folder: Path, stage: Path, progress: Progress, calibration: Sequence[Path], title: str) -> None:
    """Write settings and picture of a cell into its staged folder; messages name `folder`."""

    def say(note: str) -> None:
        progress.note(escape(note.replace(str(stage), str(folder))))

    if cell.models:
        progress.stage("reading objects")
    try:
        objects = _write_cell(cell, escape(str(folder)), stage, say)
    except ConfigError as error:
        raise _named(error, calibration, stage / CELL) from None
    draw_cell(stage / CELL, title, stage / PICTURE, progress, say, objects)


def _check_folder(folder: Path, place: Path) -> None:
    """Raise OutputError unless a folder is new or empty, and outside of data sets."""
    check_output_file(folder, "DIR", is_folder=True)
    try:
        taken = os.path.lexists(place) and any(place.iterdir())
    except OSError as error:
        raise OutputError(f"{folder} cannot be used: {error.strerror}; new-cell takes a new or an empty folder") from None
    if taken:
        raise OutputError(f"{folder} is not empty; new-cell takes a new or an empty folder")


def _parse_density(text: str | None) -> float | None:
    """Density [kg/m³] of a material, or of a number; raises ConfigError."""
    if text is None or text.lower() in MATERIALS:
        return None if text is None else MATERIALS[text.lower()]
    try:
        density = float(text)
    except ValueError:
        density = 0.0
    if not _DENSITIES[0] <= density <= _DENSITIES[1]:
        hint = f"; did you mean {1e3 * density:g}?" if 0.1 < density < _DENSITIES[0] else suggest(text.lower(), list(MATERIALS))
        raise ConfigError(
            f"--density is {format_value(text)}; allowed: {_DENSITIES[0]:g} to {_DENSITIES[1]:g} kg/m³, or {', '.join(MATERIALS)}{hint}"
        )
    return density


def _check_mass(mass: float | None, density: str | None) -> float | None:
    """Mass of each part [kg]; raises ConfigError if there is a density as well, or no body weighs so much."""
    if mass is not None and density is not None:
        raise ConfigError("--mass is given beside --density; allowed: one of both")
    if mass is not None and not MASS_RANGE[0] <= mass <= MASS_RANGE[1]:
        raise ConfigError(f"--mass is {mass:g}; allowed: {MASS_RANGE[0]:g} to {MASS_RANGE[1]:g} kg")
    return mass


def _check_parts(parts: Sequence[Path], options: dict[str, Any]) -> None:
    """Check the files of parts by their names, and that they are whole; `options` need parts. Raises ConfigError if one is missing or
    refers to other files, two have one name, a folder stands beside others, or the unit is unknown."""
    from synpick_warp.scenes.assets.meshes import SUFFIXES

    unit = options["--unit"]
    if unit is not None and unit not in UNITS:
        raise ConfigError(f"--unit is {format_value(unit)}; allowed: {', '.join(UNITS)}{suggest(unit, list(UNITS))}")
    for name, value in options.items():
        if value is not None and not parts:
            raise ConfigError(f"{name} is given without --part; the embedded objects have sizes and masses of their own")
    if len(parts) > 1 and any(file.is_dir() for file in parts):
        raise ConfigError("--part names a folder beside other parts; allowed: one folder, or files")
    stems = [file.stem for file in parts]
    for file in parts:
        if stems.count(file.stem) > 1:
            raise ConfigError(f"--part names {format_value(file.stem)} {stems.count(file.stem)} times; rename one of the files")
        if file.is_dir():
            continue
        if file.suffix.lower() not in SUFFIXES:
            if not os.path.lexists(file):
                raise ConfigError(f"there is no file or folder {file}, which --part names")
            raise ConfigError(f"--part is {format_value(str(file))}; allowed: a file that ends in {', '.join(SUFFIXES)}, or a folder")
        if _refers(file):
            raise ConfigError(f"--part is {file}, which refers to other files; name its folder, which is then used where it is")


def _content(file: Path) -> bytes:
    from synpick_warp.scenes.assets.asset_files import MAX_MESH_FILE

    return read_file(file, MAX_MESH_FILE, CatalogError)


def _refers(file: Path) -> bool:
    mark = _OTHER_FILES.get(file.suffix.lower())
    return mark is not None and re.search(mark, _content(file), re.MULTILINE) is not None


def _copy(file: Path, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    (folder / file.name).write_bytes(_content(file))


def _read_bin(text: str, unit: str | None, up: str | None, collision: str | None) -> BinRow:
    """Bin of a size, or of a mesh file, which is measured; raises ConfigError if there is neither, the file cannot be used as a bin, or its
    options are unknown or without it."""
    from synpick_warp.scenes.assets.meshes import SUFFIXES
    from synpick_warp.scenes.bin_meshes.reading import read_bin

    is_mesh = Path(text).suffix.lower() in SUFFIXES
    options = (("--bin-unit", unit, tuple(UNITS)), ("--bin-up", up, AXES), ("--bin-collision", collision, COLLISIONS))
    for name, value, allowed in options:
        if value is not None and not is_mesh:
            raise ConfigError(f"{name} is given without a mesh file; allowed: beside --bin FILE, which ends in {', '.join(SUFFIXES)}")
        if value is not None and value not in allowed:
            raise ConfigError(f"{name} is {format_value(value)}; allowed: {', '.join(allowed)}{suggest(value, list(allowed))}")
    if not is_mesh:
        return bin_of_size(_parse_size(text))
    row = BinRow(name="bin", file=os.path.abspath(text), unit=unit or "m", up=up or "z", collision=collision)
    try:
        return replace(row, measured=read_bin(row).measured)
    except ConfigError as error:
        said = str(error).removeprefix(f"bin {row.name}: ").replace(os.path.abspath(text), text)
        raise ConfigError(re.sub(r'\b(unit|up|collision) = "', r'--bin-\1 "', said)) from None


def _copy_bin(row: BinRow, stage: Path) -> BinRow:
    """Copy the mesh of a bin, if it has one; the name of its file becomes relative. One that refers to others is used where it is."""
    if not row.file:
        return row
    file = Path(row.file)
    if _refers(file):
        return replace(row, file=os.path.relpath(os.path.realpath(file), stage))
    _copy(file, stage / BINS)
    return replace(row, file=f"{BINS}/{file.name}")


def _parse_size(text: str) -> tuple[float, float, float]:
    """Parse "600x400x220mm" into lengths [m]; raises ConfigError if the text has another form, or no bin has this size."""
    match = _SIZE.fullmatch(text.strip())
    try:
        numbers = [float(match[index]) for index in (1, 2, 3)] if match else []
    except ValueError:
        numbers = []
    if not match or not numbers:
        raise ConfigError(f"--bin is {format_value(text)}; allowed: LENGTHxWIDTHxHEIGHT in metres, or as 600x400x220mm, or a mesh file")
    length, width, height = (round(number * UNITS[match[4] or "m"], 6) for number in numbers)
    if not (_SIDES[0] <= min(length, width) <= max(length, width) <= _SIDES[1] and _HEIGHTS[0] <= height <= _HEIGHTS[1]):
        hint = "; did you mean mm?" if not match[4] and min(numbers) >= 10.0 else ""
        rule = f"{_SIDES[0]:g} to {_SIDES[1]:g} m long and wide, {_HEIGHTS[0]:g} to {_HEIGHTS[1]:g} m high"
        raise ConfigError(f"--bin is {length:g} x {width:g} x {height:g} m; allowed: {rule}{hint}")
    return length, width, height


@contextmanager
def _staged(folder: Path, place: Path) -> Iterator[Path]:
    """A folder beside `place` whose content moves there if nothing is raised; otherwise nothing stays. Messages name `folder`."""
    stage = place.with_name(f".{place.name}.{os.getpid()}")
    created = [parent for parent in stage.parents if not os.path.lexists(parent)]
    try:
        make_folder(stage)
        yield stage
        if os.path.lexists(place):
            # The settings last: without them, it is no cell.
            for name in sorted(os.listdir(stage), key=lambda name: name == CELL):
                (stage / name).rename(place / name)
            stage.rmdir()
        else:
            stage.rename(place)
    except SynpickError as error:
        raise type(error)(str(error).replace(str(stage), str(folder))) from None
    except UnicodeEncodeError:
        raise OutputError(f"cannot write {folder / CELL}: the name of a file or folder in it is not UTF-8; rename that") from None
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; free space or rights there, or name another folder") from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        for parent in created:
            with contextlib.suppress(OSError):
                parent.rmdir()


def _read_cameras(files: Sequence[Path], resolution: str | None, model: str, stage: Path) -> list[tuple[CameraRow, dict[str, Any]]]:
    """Cameras of calibration files, with the keys of their tables; without files two with a field of view. Raises ConfigError if a file
    cannot be used, or does not say the size of the image."""
    if model not in ("", *MODELS):
        raise ConfigError(f"--lens is {format_value(model)}; allowed: {', '.join(MODELS)}{suggest(model, MODELS)}")
    size = None if resolution is None else parse_resolution(resolution)
    if size and not all(1 <= side <= MAX_SIDE for side in size):
        raise ConfigError(f"--resolution is {resolution}; allowed: each side at least 1, at most {MAX_SIDE} [px]")
    if not files:
        pixels = (size[0], size[1]) if size else _RESOLUTION
        return [(CameraRow(name=name, resolution=pixels, fov=_FOV), {"resolution": pixels, "fov": _FOV}) for name in ("top", "side")]
    rows = []
    for file in files:
        found = read_calibration(file, model)
        name = _name_camera(file.stem, [row.name for row, _ in rows])
        given: dict[str, Any] = {"file": os.path.relpath(os.path.realpath(file), stage)}
        pixels = (found.width, found.height)
        if not found.width:
            if size is None:
                raise ConfigError(f"{file} does not say the image's size; add --resolution WIDTHxHEIGHT")
            pixels = (size[0], size[1])
            given["resolution"] = pixels
        if model and found.distortion:
            given["model"] = model
        matrix = ((found.fx, 0.0, found.cx), (0.0, found.fy, found.cy), (0.0, 0.0, 1.0))
        row = CameraRow(name=name, resolution=pixels, matrix=matrix, distortion=found.distortion or None, model=found.model)
        try:
            lens_map(row)
        except ConfigError as error:
            raise ConfigError(f"{file}: {error}") from None
        rows.append((row, given))
    return rows


def _named(error: ConfigError, files: Sequence[Path], settings: Path) -> ConfigError:
    """Error on a camera that names its calibration file, in place of the settings, which are not kept; others as they are."""
    match = re.match(r"camera\[(\d+)\]", str(error))
    if match is None or not files:
        return error
    return ConfigError(f"{files[int(match[1])]}: {error}".replace(f" in {settings}", ""))


def _name_camera(stem: str, taken: Sequence[str]) -> str:
    """Name of a camera after its file, which differs from those that are taken."""
    name = re.sub(r"[^a-z0-9_]+", "_", stem.lower()).strip("_")
    name = name[:_LONGEST] if NAME.fullmatch(name[:_LONGEST]) and name not in RESERVED else f"camera_{name}"[:_LONGEST].strip("_")
    return next(each for each in (name, *(f"{name}_{number}" for number in range(2, 1000))) if each not in taken)


def _write_cell(cell: NewCell, name: str, stage: Path, say: Callable[[str], None]) -> list[RawObject] | None:
    """Write the settings, with a volume budget and masses for the parts, moved to their middle if that is far from their origin; returns
    the parts, None: the embedded objects. `say`: called with lines on them. Raises SynpickError if a setting, or a part, cannot be used."""
    from synpick_warp.scenes.catalog import describe_masses, read_objects

    lines: list[str] = []

    def write(cell: NewCell) -> Config:
        (stage / CELL).write_text(cell_toml(cell, name), encoding="utf-8")
        return load_settings(stage / CELL)

    def read(cell: NewCell, symmetries: str) -> list[RawObject]:
        config = write(cell)
        lines.clear()
        objects = replace(config.objects, strict=cell.models == PARTS, symmetries=symmetries)
        return read_objects(config.bake.models, objects, config.object_rows, config.cell.bins, lines.append)

    if not cell.models:
        write(cell)
        return None
    try:
        try:
            off = any(_is_off_centre(raw) for raw in read(cell, DECLARED))
        except CatalogError as error:
            if "objects.center" not in str(error):
                raise
            off = True
        cell = replace(cell, center=off)
        found = read(cell, DETECT)
    except CatalogError as error:
        raise CatalogError(str(error).replace('objects.unit = "', '--unit "')) from None
    named = [(raw.obj_id, raw.name) for raw in found] if cell.mass else []
    config = write(replace(cell, volume=2.0 * max(raw.hull.volume for raw in found), weighed=named))
    for line in filter(None, (*lines, "" if cell.mass else describe_masses(found, config.objects))):
        say(line)
    return found


def _is_off_centre(raw: RawObject) -> bool:
    """Whether the bounding box of an object lies so far off its origin that validate warns; not of BOP models, which stay as they are."""
    low, high = raw.mesh.vertices.min(axis=0), raw.mesh.vertices.max(axis=0)
    return raw.source is None and float(np.linalg.norm(low + high)) > 2.0 * _OFF_CENTRE * float(np.linalg.norm(high - low))
