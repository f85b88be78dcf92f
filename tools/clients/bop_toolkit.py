"""BOP toolkit: scenes and shards by its own loaders, and models by its PLY reader. It is on no package index: `--bop-toolkit DIR`."""

# Runs where the toolkit is, which the type checker does not see.
# pyright: reportMissingImports=false

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import MILLIMETERS, Reading, Sources, first_scene, make_matrix, sample_frames, sampled_views

PACKAGES = ("bop_toolkit_lib", "numpy")
BOUNDS = {"depth": 1e-5, "world_to_camera": 1e-12, "object_to_camera": 1e-12, "model": 1e-4}
"""Bounds of the largest absolute difference: depth and poses, in the toolkit in millimetres, [m]; models in float32 [mm]."""


def find(data: Path, sources: Sources) -> Path | None:
    """Folder of the first scene; None: there is none."""
    return first_scene(data)


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Views of a scene, and one of each from its shard; the first model."""
    if sources.bop_toolkit:
        sys.path.insert(0, sources.bop_toolkit)
    from bop_toolkit_lib import inout, misc
    from bop_toolkit_lib.dataset import bop_scenewise

    scene = bop_scenewise.load_scene_data(place)
    cameras, truth, infos = scene["scene_camera"], scene["scene_gt"], scene["scene_gt_info"]
    values: dict[str, np.ndarray] = {}
    for frame in sample_frames(len(cameras)):
        camera, rows = cameras[frame], truth[frame]
        (color,) = (place / "rgb").glob(f"{frame:06d}.*")
        values[f"rgb {frame}"] = inout.load_im(color)
        values[f"depth {frame}"] = inout.load_depth(place / f"depth/{frame:06d}.png") * camera["depth_scale"] / MILLIMETERS
        values[f"cam_K {frame}"] = camera["cam_K"]
        values[f"world_to_camera {frame}"] = make_matrix(camera["cam_R_w2c"], camera["cam_t_w2c"])
        values[f"object_to_camera {frame}"] = np.array([make_matrix(row["cam_R_m2c"], row["cam_t_m2c"]) for row in rows]).reshape(-1, 4, 4)
        values[f"obj_id {frame}"] = np.array([row["obj_id"] for row in rows])
        values[f"visib_fract {frame}"] = np.array([row["visib_fract"] for row in infos[frame]])
        if rows and (place / "mask").is_dir():
            for name in ("mask", "mask_visib"):
                values[f"{name} {frame}"] = bop_scenewise.load_masks(place, frame, name, len(rows)) > 0
    values |= _read_shard(place)
    model = inout.load_ply(data / "models" / f"obj_{_first_model(data):06d}.ply")
    values["model"] = model["pts"]
    infos = json.loads((data / "models" / "models_info.json").read_text())
    values["symmetries"] = np.array([len(misc.get_symmetry_transformations(info, 0.01)) > 0 for info in infos.values()])
    shards = any(name.startswith("shard") for name in values)
    what = f"{place.parent.name}/{place.name}{', its shard' if shards else ''}, a model"
    return Reading(what, values, versions=_read_version(Path(inout.__file__).parents[1]))


def _read_shard(scene: Path) -> dict[str, np.ndarray]:
    """Masks and colour of the first view, as the toolkit's reader of shards gives them."""
    from bop_toolkit_lib.dataset import bop_webdataset

    shard = scene.parent.with_name(f"{scene.parent.name}_web") / f"shard-{scene.name}.tar"
    if not shard.is_file():
        return {}
    suffix = next((scene / "rgb").iterdir()).suffix
    view = bop_webdataset.load_image_data(shard, f"{scene.name}_000000", load_mask=True, load_gt=True, load_gt_info=True, rgb_suffix=suffix)
    return {"shard rgb": view["im_rgb"], "shard mask": np.asarray(view["mask"]) > 0}


def _read_version(folder: Path) -> dict[str, str]:
    """Version of a copy of the toolkit, from its pyproject.toml."""
    project = folder / "pyproject.toml"
    found = re.search(r'^version = "(.*)"', project.read_text() if project.is_file() else "", re.MULTILINE)
    return {"bop_toolkit_lib": found[1]} if found else {}


def _first_model(data: Path) -> int:
    """Lowest obj_id of models_info.json."""
    return min(int(key) for key in json.loads((data / "models" / "models_info.json").read_text()))


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from the views in memory; every object has at least one symmetry transformation, the identity."""
    import trimesh

    values: dict[str, np.ndarray] = {}
    for frame, view in sampled_views(data_set).items():
        values |= {f"rgb {frame}": view.rgb, f"depth {frame}": view.depth, f"cam_K {frame}": view.intrinsics}
        values |= {f"world_to_camera {frame}": view.world_to_camera, f"object_to_camera {frame}": view.object_to_camera}
        values |= {f"obj_id {frame}": view.object_ids, f"visib_fract {frame}": view.visibility}
        values |= {f"mask {frame}": view.amodal_masks, f"mask_visib {frame}": view.masks}
        if frame == 0:
            values |= {"shard rgb": view.rgb, "shard mask": view.amodal_masks}
    index = _first_model(data_set.folder)
    mesh = trimesh.load_mesh(data_set.folder / "models" / f"obj_{index:06d}.ply", process=False)
    return values | {"model": np.asarray(mesh.vertices), "symmetries": np.ones(len(data_set.models_info), bool)}
