"""Model files of a data set: the folder that ground truth refers to, and PLY file and symmetries of each object."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from synpick_warp.dataset.bop.layout import RENDERING_MODELS
from synpick_warp.errors import DatasetError
from synpick_warp.scenes.assets.models_info import ModelInfo, read_models_info
from synpick_warp.system.inputs.paths import path_inside

INFO = "models_info.json"


def models_folder(folder: Path) -> str:
    """Name of a data set's folder of models: "models", or another where there is none (T-LESS: models_cad); "models" if there are none."""
    return next((name for name in RENDERING_MODELS if (folder / name).is_dir()), RENDERING_MODELS[0])


def find_models(folder: Path, object_ids: Iterable[int], purpose: str) -> dict[int, tuple[Path, ModelInfo]]:
    """Find the models of objects.

    Args:
        folder: The data set.
        object_ids: Objects that are needed.
        purpose: What they are needed for, for the message: "poses are evaluated".

    Returns:
        obj_id -> PLY file [mm], and its entry of models_info.json; sorted.

    Raises:
        DatasetError: The data set has no models, or an object has none.
        CatalogError: models_info.json is damaged, or lacks an object.
    """
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
