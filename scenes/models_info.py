"""BOP model folders: obj_ids in file names, and models_info.json (diameters, symmetries)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.errors import CatalogError

_NAME = re.compile(r"obj_(\d+)\.ply", re.IGNORECASE)
_MILLIMETRE = 1e-3
# Published matrices have six digits.
_ROTATION_TOLERANCE = 1e-3
# Length to which wrong values are truncated in errors.
_SHOWN = 60


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
        CatalogError: Two files have the same obj_id.
    """
    models: dict[int, Path] = {}
    for file in files:
        if match := _NAME.fullmatch(file.name):
            obj_id = int(match[1])
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
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CatalogError(f"{path}: not readable as JSON ({error}); repair it, or remove it to go without symmetries") from error
    if not isinstance(content, dict):
        raise CatalogError(f'{path}: a {type(content).__name__}; needed is an object with an entry for each obj_id, such as "1"')
    infos = {}
    for obj_id in obj_ids:
        entry = content.get(str(obj_id))
        if not isinstance(entry, dict):
            raise CatalogError(f"{path}: no entry for object {obj_id}; add one, or remove the file to go without symmetries")
        infos[obj_id] = _info(entry, f"{path}: object {obj_id}")
    return infos


def _info(entry: dict[str, Any], place: str) -> ModelInfo:
    diameter = None
    if (given := entry.get("diameter")) is not None:
        if type(given) not in (int, float) or not 0.0 < given < np.inf:
            raise CatalogError(f"{place}: diameter is {_short(given)}; needed: a number above 0, in mm")
        diameter = float(given) * _MILLIMETRE
    discrete = [_rigid(value, where) for where, value in _rows(entry, "symmetries_discrete", place)]
    continuous = [_axis(value, where) for where, value in _rows(entry, "symmetries_continuous", place)]
    return ModelInfo(diameter, tuple(discrete), tuple(continuous))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "…"


def _rows(entry: dict[str, Any], key: str, place: str) -> list[tuple[str, Any]]:
    """The elements of a list, each with its path for errors."""
    rows = entry.get(key, [])
    if not isinstance(rows, list):
        raise CatalogError(f"{place}: {key} is {_short(rows)}; needed: a list")
    return [(f"{place}: {key}[{index}]", row) for index, row in enumerate(rows)]


def _numbers(value: Any, count: int, place: str) -> np.ndarray:
    if not isinstance(value, list) or len(value) != count or not all(type(item) in (int, float) and np.isfinite(item) for item in value):
        raise CatalogError(f"{place} is {_short(value)}; needed: {count} finite numbers")
    return np.array(value, dtype=np.float64)


def _rigid(value: Any, place: str) -> tuple[float, ...]:
    matrix = _numbers(value, 16, place).reshape(4, 4)
    rotation = matrix[:3, :3]
    off = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(matrix[3] - (0, 0, 0, 1)).max(), abs(np.linalg.det(rotation) - 1.0))
    if off > _ROTATION_TOLERANCE:
        raise CatalogError(f"{place}: not a rotation and translation; needed: a rigid 4 x 4 matrix, row by row")
    matrix[:3, 3] *= _MILLIMETRE
    return tuple(float(value) for value in matrix.reshape(-1))


def _axis(value: Any, place: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    if not isinstance(value, dict):
        raise CatalogError(f"{place} is {_short(value)}; needed: an object with axis and offset")
    axis = _numbers(value.get("axis"), 3, f"{place}.axis")
    offset = _numbers(value.get("offset", [0, 0, 0]), 3, f"{place}.offset") * _MILLIMETRE
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        raise CatalogError(f"{place}.axis is zero; needed: a direction")
    axis = axis / length
    return (float(axis[0]), float(axis[1]), float(axis[2])), (float(offset[0]), float(offset[1]), float(offset[2]))
