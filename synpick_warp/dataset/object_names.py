"""Names of a data set's objects, from its models and its settings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from synpick_warp.configs.schema import ObjectRow
from synpick_warp.dataset.annotations import Key, ModelDiameter, read_checked
from synpick_warp.dataset.bop.models import INFO, models_folder
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import check_regular_file

if TYPE_CHECKING:
    from synpick_warp.dataset.reading import DataSet

_MODEL_NAME = re.compile(rb"^comment (.+), millimetres\r?$", re.MULTILINE)
"""Comment in a PLY file that the BOP exporter wrote: the object's name."""
_PLY_HEAD = 2048
"""Size of the part of a PLY file that is searched for comments [B]."""
_MAX_MODEL = 2**40
"""Largest PLY file [B]; only its head is read."""


def object_names(dataset: Path, object_ids: set[int], rows: Sequence[ObjectRow] = (), tolerance: float = 0.0) -> dict[int, str]:
    """Names of objects (obj_id -> name): from the exported model's comment, else from the settings' object table; some have none.

    `rows`, `tolerance`: the object table, and `objects.diameter_tolerance`.
    """
    folder = dataset / models_folder(dataset)
    infos = read_checked(folder / INFO, dict[Key, ModelDiameter])
    names = {}
    for object_id in object_ids:
        path = folder / f"obj_{object_id:06d}.ply"
        comment = None
        if path.exists():
            check_regular_file(path, _MAX_MODEL, DatasetError)
            with path.open("rb") as file:
                comment = _MODEL_NAME.search(file.read(_PLY_HEAD))
        size = float(infos.get(object_id, {}).get("diameter", 0.0)) / 1000.0
        fits = (row.name for row in rows if row.id == object_id and _fits(row.diameter, size, tolerance))
        name = comment[1].decode(errors="replace") if comment else next(fits, "")
        if name:
            names[object_id] = name
    return names


def names_of(data: DataSet) -> dict[int, str]:
    """Names of a data set's objects: from the trajectory store, else from models and settings, else "obj_NNNNNN"; none without both."""
    if data.has_store:
        return {item.object_id: item.name for item in data.objects}
    config = data.config
    if not {"bop", "shards"} & set(config.bake.formats):
        return {}
    known = object_names(data.folder, set(data.models_info), config.object_rows, config.objects.diameter_tolerance)
    return {index: known.get(index, f"obj_{index:06d}") for index in data.models_info}


def _fits(expected: float, size: float, tolerance: float) -> bool:
    """Whether a model's diameter matches that of a row in the object table [m]; a row without one matches any."""
    return expected == 0.0 or abs(size - expected) <= tolerance * expected
