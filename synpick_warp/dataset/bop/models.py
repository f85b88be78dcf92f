"""Model files of a data set: the folder that ground truth refers to, PLY file and symmetries of each object, and the objects' names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from synpick_warp.configs.schema import ObjectRow
from synpick_warp.dataset.annotations import Key, ModelDiameter, read_checked
from synpick_warp.dataset.bop.layout import RENDERING_MODELS
from synpick_warp.errors import DatasetError
from synpick_warp.scenes.assets.models_info import FileModelInfo, read_models_info
from synpick_warp.system.inputs.files import check_regular_file, path_inside

if TYPE_CHECKING:
    from synpick_warp.dataset.reading import DataSet

INFO = "models_info.json"
_MODEL_NAME = re.compile(rb"^comment (.+), millimetres\r?$", re.MULTILINE)
"""Comment in a PLY file that the BOP exporter wrote: the object's name."""
_PLY_HEAD = 2048
"""Size of the part of a PLY file that is searched for comments [B]."""
_MAX_MODEL = 2**40
"""Largest PLY file [B]; only its head is read."""


def models_folder(folder: Path) -> str:
    """Name of a data set's folder of models: "models", or another where there is none (T-LESS: models_cad); "models" if there are none."""
    return next((name for name in RENDERING_MODELS if (folder / name).is_dir()), RENDERING_MODELS[0])


def find_models(folder: Path, object_ids: Iterable[int], purpose: str) -> dict[int, tuple[Path, FileModelInfo]]:
    """Find the models of objects: obj_id -> PLY file [mm], and its entry of models_info.json; sorted. `purpose`, such as "poses are
    evaluated", is for messages. Raises DatasetError if the data set has no models, or an object has none, and CatalogError if
    models_info.json is damaged, or lacks an object."""
    models = models_folder(folder)
    info = path_inside(folder, f"{models}/{INFO}", folder, DatasetError)
    if not info.is_file():
        raise DatasetError(f"{folder} has no {models}/{INFO}, which {purpose} with; bake with --formats bop or shards, or add BOP's models")
    wanted = sorted(set(object_ids))
    infos = read_models_info(info, wanted)
    found = {}
    for object_id in wanted:
        name = f"{models}/obj_{object_id:06d}.ply"
        path = path_inside(folder, name, folder, DatasetError)
        if not path.is_file():
            raise DatasetError(
                f"{folder} has no {name}, the model of an object in its ground truth; restore it, or bake the data set again"
            )
        found[object_id] = path, infos[object_id]
    return found


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
        # A row without a diameter matches any.
        fits = (row.name for row in rows if row.id == object_id and abs(size - (row.diameter or size)) <= tolerance * row.diameter)
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
