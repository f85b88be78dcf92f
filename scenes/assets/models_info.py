"""BOP model folders: obj_ids in file names, and models_info.json (diameters, symmetries)."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.inputs.json import read_json

MAX_OBJ_ID = 2**31 - 1
"""Largest obj_id: data sets keep them in 32 bits."""
MAX_INFO = 2**24
"""Largest models_info.json [bytes]: 16 MiB; an entry has 1 kB."""
MAX_DEPTH = 16
"""Maximum nesting of models_info.json; BOP's has five levels."""

_NAME = re.compile(r"obj_([0-9]+)\.ply", re.IGNORECASE)
_MILLIMETRE = 1e-3
# Published matrices have six digits.
_ROTATION_TOLERANCE = 1e-3
_ADVICE = "or remove the file to go without symmetries"
_NEEDED = "diameter above 0 in mm, symmetries_discrete of 16 numbers each, symmetries_continuous of axis and offset of 3 numbers each"

# A coordinate, or a length in mm: larger numbers are mistakes, whose squares overflow.
_Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


class _Axis(msgspec.Struct):
    """A continuous symmetry."""

    axis: tuple[_Number, _Number, _Number]
    offset: tuple[_Number, _Number, _Number] = (0.0, 0.0, 0.0)


class _Entry(msgspec.Struct):
    """What is read of an object's entry; other keys are copied as they are."""

    diameter: Annotated[float, msgspec.Meta(gt=0.0, le=1e9)] | None = None
    symmetries_discrete: list[Annotated[list[_Number], msgspec.Meta(min_length=16, max_length=16)]] = []
    symmetries_continuous: list[_Axis] = []


@dataclass(frozen=True)
class ModelInfo:
    """An entry of models_info.json, converted to metres."""

    diameter: float | None = None
    """[m]"""
    symmetries_discrete: tuple[tuple[float, ...], ...] = ()
    """Row-major 4 x 4 rigid transforms, translation in metres; without the identity."""
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    """(unit axis, point on it [m])."""


def bop_files(files: Iterable[Path]) -> dict[int, Path]:
    """Select the files that are BOP models (obj_NNNNNN.ply), by obj_id.

    Raises:
        CatalogError: Two files have the same obj_id, or one is too large.
    """
    models: dict[int, Path] = {}
    for file in files:
        if match := _NAME.fullmatch(file.name):
            obj_id = int(match[1])
            if obj_id > MAX_OBJ_ID:
                raise CatalogError(f"{file}: the number in its name is too large; allowed: 0 to {MAX_OBJ_ID}; rename the file")
            if obj_id in models:
                raise CatalogError(f"{models[obj_id]} and {file.name} are both object {obj_id}; keep one of them")
            models[obj_id] = file
    return models


def read_models_info(path: Path, obj_ids: Iterable[int]) -> dict[int, ModelInfo]:
    """Read models_info.json; an empty dictionary if the file is missing, which is no error.

    Args:
        path: The file.
        obj_ids: Objects that must have an entry; other entries are ignored.

    Raises:
        CatalogError: The file is not valid JSON or lacks an object, or an entry's diameter or symmetries are invalid.
    """
    entries = read_entries(path)
    infos = {}
    for obj_id in obj_ids if entries is not None else ():
        place, entry = f"{path}: object {obj_id}", (entries or {}).get(str(obj_id))
        if not isinstance(entry, dict):
            raise CatalogError(f"{path}: no entry for object {obj_id}; add one, {_ADVICE}")
        try:
            infos[obj_id] = _info(msgspec.convert(entry, _Entry), place)
        except msgspec.ValidationError as error:
            raise CatalogError(f"{place}: {str(error).replace('`', '')}; needed: {_NEEDED}") from None
    return infos


def read_entries(path: Path) -> dict[str, Any] | None:
    """Read the objects' entries in models_info.json as they are, by obj_id in decimal; None if the file is missing.

    Raises:
        CatalogError: The file is not a JSON object, or nested too deeply to be written again.
    """
    if not os.path.lexists(path):
        return None
    content = read_json(path, dict[str, Any], CatalogError, f"repair it, {_ADVICE}", MAX_INFO)
    if _depth(content) > MAX_DEPTH:
        raise CatalogError(f"{path}: nested deeper than {MAX_DEPTH}; repair it, {_ADVICE}")
    return content


def _depth(content: Any) -> int:
    """Depth of nested objects and lists; ends a level below MAX_DEPTH."""
    level, depth = [content], 0
    while level and depth <= MAX_DEPTH:
        level = [item for each in level if isinstance(each, dict | list) for item in (each.values() if isinstance(each, dict) else each)]
        depth += 1
    return depth


def _info(entry: _Entry, place: str) -> ModelInfo:
    return ModelInfo(
        None if entry.diameter is None else entry.diameter * _MILLIMETRE,
        tuple(
            matrix
            for index, given in enumerate(entry.symmetries_discrete)
            if not _is_identity(matrix := _rigid(given, f"{place}: symmetries_discrete[{index}]"))
        ),
        tuple(_axis(axis, f"{place}: symmetries_continuous[{index}]") for index, axis in enumerate(entry.symmetries_continuous)),
    )


def _rigid(value: list[float], place: str) -> tuple[float, ...]:
    matrix = np.array(value, dtype=np.float64).reshape(4, 4)
    rotation = matrix[:3, :3]
    off = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(matrix[3] - (0, 0, 0, 1)).max(), abs(np.linalg.det(rotation) - 1.0))
    if off > _ROTATION_TOLERANCE:
        raise CatalogError(f"{place}: not a rotation and translation; needed: a rigid 4 x 4 matrix, row by row")
    matrix[:3, 3] *= _MILLIMETRE
    return tuple(float(value) for value in matrix.reshape(-1))


def _is_identity(matrix: tuple[float, ...]) -> bool:
    """Whether a transform leaves everything in place: some data sets list the identity, which makes no object symmetric."""
    return bool(np.abs(np.reshape(matrix, (4, 4)) - np.eye(4)).max() < _ROTATION_TOLERANCE)


def _axis(value: _Axis, place: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    axis, offset = np.array(value.axis, dtype=np.float64), np.array(value.offset, dtype=np.float64) * _MILLIMETRE
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        raise CatalogError(f"{place}.axis is zero; needed: a direction")
    axis = axis / length
    return (float(axis[0]), float(axis[1]), float(axis[2])), (float(offset[0]), float(offset[1]), float(offset[2]))
