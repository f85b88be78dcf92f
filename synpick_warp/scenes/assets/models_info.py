"""BOP model folders: obj_ids in file names, and models_info.json (diameters, symmetries)."""

import json
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.system.inputs.files import read_json
from synpick_warp.system.linear_algebra import det, dot, matmul, norm

MAX_OBJ_ID = 2**31 - 1
"""Largest obj_id: data sets keep them in 32 bits."""
MAX_INFO = 2**24
"""Largest models_info.json [bytes]: 16 MiB; an entry has 1 kB."""
MAX_DEPTH = 16
"""Maximum nesting of models_info.json; BOP's has five levels."""

_KEY = re.compile(r"\s*\+?0*([0-9]{1,10})\s*", re.ASCII)
_NAME = re.compile(r"obj_([0-9]+)\.ply", re.IGNORECASE)
_MILLIMETRE = 1e-3
ROTATION_TOLERANCE = 1e-3
"""Of the elements of a rigid transform: published matrices have six digits."""
_ADVICE = "or remove the file to go without symmetries"
_NEEDED = "diameter above 0 in mm, symmetries_discrete of 16 numbers each, symmetries_continuous of axis and offset of 3 numbers each"

_SYMMETRIES = ("symmetries_discrete", "symmetries_continuous")
_EXTENTS = ("min_x", "min_y", "min_z", "size_x", "size_y", "size_z")
# Relative difference between a diameter or extent and that of the mesh, from which it belongs to another mesh.
_TOLERANCE = 0.1
# Relative difference from which a diameter that is the bounding box's diagonal is wrong, and within which it is the diagonal.
_OFF, _SAME = 0.01, 1e-3
# A symmetry that displaces the surface by more than this fraction of the diameter is none: scans of symmetric objects stay within 0.05.
_ASYMMETRY = 0.1
# Directions in which surfaces are compared, and vertices that are looked at.
_DIRECTIONS, _SAMPLES = 128, 20_000
_TURNS = 8
"""Rotations by which a continuous symmetry is checked."""

# A coordinate, or a length in mm: larger numbers are mistakes, whose squares overflow.
_MAX_NUMBER = 1e9
_Number = Annotated[float, msgspec.Meta(ge=-_MAX_NUMBER, le=_MAX_NUMBER)]


class _Axis(msgspec.Struct):
    """Schema of a continuous symmetry: axis and a point on it, in the units of the file."""

    axis: tuple[_Number, _Number, _Number]
    offset: tuple[_Number, _Number, _Number] = (0.0, 0.0, 0.0)


class _Entry(msgspec.Struct):
    """Schema of an object's entry: diameter and symmetries. Other keys are copied without validation."""

    diameter: Annotated[float, msgspec.Meta(gt=0.0, le=1e9)] | None = None
    symmetries_discrete: list[Annotated[list[_Number], msgspec.Meta(min_length=16, max_length=16)]] = []
    symmetries_continuous: list[_Axis] = []


@dataclass(frozen=True)
class FileModelInfo:
    """Diameter, symmetries and bounding box of an entry of models_info.json, converted to metres."""

    diameter: float | None = None
    """[m]"""
    symmetries_discrete: tuple[tuple[float, ...], ...] = ()
    """Row-major 4 x 4 rigid transforms, translation in metres; without the identity."""
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    """(unit axis, point on it [m])."""
    extents: tuple[float, ...] | None = None
    """Least coordinates and sizes of the bounding box, x, y, z each [m]; None: not all are given."""


def bop_obj_id(file: Path) -> int | None:
    """The obj_id in the name of a BOP model (obj_NNNNNN.ply); None for other files. Raises CatalogError: the number is too large."""
    match = _NAME.fullmatch(file.name)
    if match is None:
        return None
    if int(match[1]) > MAX_OBJ_ID:
        raise CatalogError(f"{file}: the number in its name is too large; allowed: 0 to {MAX_OBJ_ID}; rename the file")
    return int(match[1])


def _raise(error: CatalogError) -> None:
    """Default for `fault`: raises the error."""
    raise error


def read_models_info(path: Path, obj_ids: Iterable[int], fault: Callable[[CatalogError], None] = _raise) -> dict[int, FileModelInfo]:
    """Read models_info.json; an empty dictionary if the file is missing, which is no error. `obj_ids`: objects that must have an entry;
    other entries are ignored. `fault`: called with the error of an object that has no entry, or one whose diameter or symmetries are
    invalid. If it does not raise it, the object has no entry in the result. Raises CatalogError: the file is not valid JSON."""
    entries = read_entries(path)
    infos = {}
    for obj_id in obj_ids if entries is not None else ():
        try:
            infos[obj_id] = _convert((entries or {}).get(str(obj_id)), obj_id, path)
        except CatalogError as error:
            fault(error)
    return infos


def _convert(entry: Any, obj_id: int, path: Path) -> FileModelInfo:
    place = f"{path}: object {obj_id}"
    if not isinstance(entry, dict):
        raise CatalogError(f"{path}: no entry for object {obj_id}; add one, {_ADVICE}")
    given = [entry.get(key) for key in _EXTENTS]
    extents = tuple(value * _MILLIMETRE for value in given if isinstance(value, int | float) and abs(value) < _MAX_NUMBER)
    try:
        return replace(_info(msgspec.convert(entry, _Entry), place), extents=extents if len(extents) == len(_EXTENTS) else None)
    except msgspec.ValidationError as error:
        raise CatalogError(f"{place}: {str(error).replace('`', '')}; needed: {_NEEDED}") from None


def check_against_mesh(info: FileModelInfo, vertices: np.ndarray, diameter: float) -> tuple[FileModelInfo, list[str]]:
    """Compare an entry with its mesh, of vertices (V, 3) and a diameter [m]: is the diameter the bounding box's diagonal, or of another
    mesh, and do the symmetries hold? Returns the entry, converted if its lengths are in metres, and what is wrong with it. Raises
    CatalogError: the mesh is in metres, where the entry is in millimetres."""
    low = vertices.min(axis=0).astype(np.float64)
    size = vertices.max(axis=0) - low
    info, said = compare_sizes(info, low, size, diameter)
    return info, said + _check_symmetries(info, vertices[:: -(-len(vertices) // _SAMPLES)].astype(np.float64), diameter)


def compare_sizes(info: FileModelInfo, low: np.ndarray, size: np.ndarray, diameter: float) -> tuple[FileModelInfo, list[str]]:
    """The part of `check_against_mesh` that needs the mesh's bounding box (least coordinates and size, 3 each) and diameter [m] only."""
    said = []
    diagonal = float(norm(size))
    if info.diameter is not None and any(_near(info.diameter / _MILLIMETRE, own, _TOLERANCE) for own in (diameter, diagonal)):
        given, own = f"{info.diameter / _MILLIMETRE:.4g}", f"{diameter / _MILLIMETRE:.4g} mm"
        said.append(f"diameter {given}, where its mesh has {own}: lengths in metres; they are converted")
        info = _scaled(info, 1.0 / _MILLIMETRE)
    elif info.diameter is not None and any(_near(info.diameter * _MILLIMETRE, own, _TOLERANCE) for own in (diameter, diagonal)):
        given = f"{info.diameter / _MILLIMETRE:.4g}"
        raise CatalogError(f"its diameter is {diameter / _MILLIMETRE:.4g} mm, but models_info.json says {given}; scale it to millimetres")
    if info.diameter is not None and not _near(info.diameter, diameter, _OFF):
        named = f"diameter {info.diameter / _MILLIMETRE:.4g} mm"
        own = f"its own, {diameter / _MILLIMETRE:.4g} mm, is used"
        if _near(info.diameter, diagonal, _SAME):
            said.append(f"{named}, which is the diagonal of its bounding box; {own}")
        elif not _near(info.diameter, diameter, _TOLERANCE):
            said.append(f"{named}, which belongs to another mesh; {own}")
    if info.extents is not None and np.abs(np.asarray(info.extents) - (*low, *size)).max() > _TOLERANCE * diameter:
        given, own = (" x ".join(f"{value / _MILLIMETRE:.4g}" for value in sizes) for sizes in (info.extents[3:], size))
        said.append(f"a bounding box of {given} mm, or elsewhere than it is; its own, {own} mm, is used")
    return info, said


def corrected_entry(entry: Any, own: dict[str, Any]) -> dict[str, Any]:
    """An object's entry for a data set: as it is if it agrees with the mesh, else with the sizes of its `own` [mm], or `own` altogether.

    Symmetries are those of `own` where these are others.
    """
    low, size = (np.array([own[key] for key in keys]) * _MILLIMETRE for keys in (_EXTENTS[:3], _EXTENTS[3:]))
    try:
        info = _convert(entry, 0, Path())
        _, said = compare_sizes(info, low, size, own["diameter"] * _MILLIMETRE)
    except CatalogError:
        return own
    if not _same_symmetries(info, _convert(own, 0, Path())):
        entry = {key: value for key, value in entry.items() if key not in _SYMMETRIES} | {
            key: own[key] for key in _SYMMETRIES if key in own
        }
    if not said:
        return entry
    return own if any("metres" in line for line in said) else entry | {key: own[key] for key in ("diameter", *_EXTENTS)}


def _same_symmetries(one: FileModelInfo, other: FileModelInfo) -> bool:
    """Whether two entries have the same symmetries, in the same order, up to rounding."""
    pairs = ((one.symmetries_discrete, other.symmetries_discrete), (one.symmetries_continuous, other.symmetries_continuous))
    return all(len(a) == len(b) and np.allclose(np.array(a), np.array(b), atol=1e-9) for a, b in pairs)


def _near(value: float, expected: float, tolerance: float) -> bool:
    """Whether a value equals the expected one within a relative tolerance."""
    return abs(value - expected) <= tolerance * expected


def _scaled(info: FileModelInfo, factor: float) -> FileModelInfo:
    """Entry with all lengths multiplied by a factor."""
    return FileModelInfo(
        None if info.diameter is None else factor * info.diameter,
        tuple(tuple(value * factor if at in (3, 7, 11) else value for at, value in enumerate(row)) for row in info.symmetries_discrete),
        tuple((axis, (factor * x, factor * y, factor * z)) for axis, (x, y, z) in info.symmetries_continuous),
        None if info.extents is None else tuple(factor * value for value in info.extents),
    )


def _check_symmetries(info: FileModelInfo, vertices: np.ndarray, diameter: float) -> list[str]:
    """Name the symmetries that do not map a mesh onto itself, by its extents (support function) in random directions."""
    from trimesh.transformations import rotation_matrix

    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= norm(directions)[:, None]
    extent = matmul(vertices, directions.T).max(axis=0)
    moves = [(f"symmetries_discrete[{index}]", [np.reshape(row, (4, 4))]) for index, row in enumerate(info.symmetries_discrete)]
    moves += [
        (f"symmetries_continuous[{index}]", [rotation_matrix(turn * 2.0 * np.pi / _TURNS, axis, offset) for turn in range(1, _TURNS)])
        for index, (axis, offset) in enumerate(info.symmetries_continuous)
    ]
    said = []
    for name, matrices in moves:
        off = 0.0
        for matrix in map(np.asarray, matrices):
            moved = matmul(vertices, matmul(directions, matrix[:3, :3]).T).max(axis=0) + dot(directions, matrix[:3, 3])
            off = max(off, float(np.abs(moved - extent).max()))
        if off > _ASYMMETRY * diameter:
            said.append(f"{name}, which moves its surface by {off / _MILLIMETRE:.3g} mm; it is used as given, correct or remove it")
    return said


def read_entries(path: Path) -> dict[str, Any] | None:
    """Read the objects' entries in models_info.json as they are, by obj_id in decimal; None if the file is missing.

    Keys are integers in decimal: "000001" is object 1. Others have no object, and are left out. Raises CatalogError: the file is not a JSON
    object, nested too deeply to be written again, or gives an object twice."""
    if not os.path.lexists(path):
        return None
    content = read_json(path, dict[str, Any], CatalogError, f"repair it, {_ADVICE}", MAX_INFO)
    if _depth(content) > MAX_DEPTH:
        raise CatalogError(f"{path}: nested deeper than {MAX_DEPTH}; repair it, {_ADVICE}")
    entries: dict[str, tuple[str, Any]] = {}
    # msgspec would take the last of equal keys; the pairs of nested objects stay lists.
    for key, _ in json.loads(path.read_bytes(), object_pairs_hook=list):
        if (match := _KEY.fullmatch(key)) is None:
            continue
        if match[1] in entries:
            raise CatalogError(f"{path}: the keys {entries[match[1]][0]!a} and {key!a} are both object {match[1]}; keep one of them")
        entries[match[1]] = key, content[key]
    return {obj_id: entry for obj_id, (_, entry) in entries.items()}


def _depth(content: Any) -> int:
    """Depth of nested objects and lists, counted up to one level below MAX_DEPTH."""
    level, depth = [content], 0
    while level and depth <= MAX_DEPTH:
        level = [item for each in level if isinstance(each, dict | list) for item in (each.values() if isinstance(each, dict) else each)]
        depth += 1
    return depth


def _info(entry: _Entry, place: str) -> FileModelInfo:
    """Convert a validated entry to metres; symmetries that are the identity are left out."""
    return FileModelInfo(
        None if entry.diameter is None else entry.diameter * _MILLIMETRE,
        tuple(
            matrix
            for index, given in enumerate(entry.symmetries_discrete)
            if not _is_identity(matrix := _rigid(given, f"{place}: symmetries_discrete[{index}]"))
        ),
        tuple(_axis(axis, f"{place}: symmetries_continuous[{index}]") for index, axis in enumerate(entry.symmetries_continuous)),
    )


def _rigid(value: list[float], place: str) -> tuple[float, ...]:
    """Validate a rigid 4 x 4 matrix, row by row [mm], and convert the translation to metres."""
    matrix = np.array(value, dtype=np.float64).reshape(4, 4)
    if not is_rigid(matrix):
        raise CatalogError(f"{place}: not a rotation and translation; needed: a rigid 4 x 4 matrix, row by row")
    matrix[:3, 3] *= _MILLIMETRE
    return tuple(float(value) for value in matrix.reshape(-1))


def is_rigid(matrix: np.ndarray) -> bool:
    """Whether a 4 x 4 matrix is a rotation and a translation."""
    turn = matrix[:3, :3]
    off = max(np.abs(matmul(turn, turn.T) - np.eye(3)).max(), np.abs(matrix[3] - (0, 0, 0, 1)).max(), abs(det(turn) - 1.0))
    return bool(off <= ROTATION_TOLERANCE)


def _is_identity(matrix: tuple[float, ...]) -> bool:
    """Whether a transform leaves everything in place: some data sets list the identity, which makes no object symmetric."""
    return bool(np.abs(np.reshape(matrix, (4, 4)) - np.eye(4)).max() < ROTATION_TOLERANCE)


def _axis(value: _Axis, place: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Normalize the axis of a continuous symmetry, and convert the offset to metres."""
    axis, offset = np.array(value.axis, dtype=np.float64), np.array(value.offset, dtype=np.float64) * _MILLIMETRE
    length = float(norm(axis))
    if length == 0.0:
        raise CatalogError(f"{place}.axis is zero; needed: a direction")
    axis = axis / length
    return (float(axis[0]), float(axis[1]), float(axis[2])), (float(offset[0]), float(offset[1]), float(offset[2]))
