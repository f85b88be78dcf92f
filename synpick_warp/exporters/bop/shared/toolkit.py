"""Entry of a data set for the BOP toolkit, which has no registry: bop_dataset_params.py, and the lines of dataset_info.md that use it."""

from typing import Any

from synpick_warp.configs.cell.cameras import COLOR, DEPTH
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.scenes.types import Camera, Catalog

PARAMS_FILE = "bop_dataset_params.py"

_HEAD = '''"""Entry of this data set for the BOP toolkit (github.com/thodan/bop_toolkit), whose dataset_params.py lists data sets by name.

Add one line to the end of bop_toolkit_lib/dataset_params.py:

    import runpy; runpy.run_path("/path/to/this/folder/bop_dataset_params.py")

The data set's name is the name of this folder as the line spells it: letters and digits only, in the folder that BOP_PATH names.
"""

import os

import bop_toolkit_lib.dataset_params as toolkit

'''
_BODY = '''

FOLDER = os.path.dirname(os.path.abspath(__file__))
NAME = os.path.basename(FOLDER)
if not (NAME.isascii() and NAME.isalnum()):
    raise ValueError(f"the toolkit splits names at other characters than letters and digits; rename {FOLDER}, or link to it")


def scene_ids(split_path):
    """Ids of the scenes that are there."""
    return sorted(int(name) for name in os.listdir(split_path) if name.isdecimal()) if os.path.isdir(split_path) else []


def split_params(datasets_path, split, split_type):
    """As get_split_params of the toolkit."""
    base = os.path.join(datasets_path, NAME)
    path = os.path.join(base, split if split_type is None else f"{split}_{split_type}")
    if os.path.basename(path) not in SPLITS:
        raise ValueError(f"{NAME} has no split {os.path.basename(path)}; splits: {', '.join(SPLITS)}")
    params = {
        "name": NAME,
        "split": split,
        "split_type": split_type,
        "base_path": base,
        "split_path": path,
        "scene_ids": scene_ids(path),
        "depth_range": None,
        "azimuth_range": None,
        "elev_range": None,
        "eval_modality": "rgb" if SENSORS else None,
        "eval_sensor": SENSORS[0] if SENSORS else None,
        "im_modalities": {sensor: ["rgb", "depth"] for sensor in SENSORS} or ["rgb", "depth"],
        "im_size": {sensor: IM_SIZE for sensor in ("", *SENSORS)} if SENSORS else IM_SIZE,
        "supported_error_types": ["ad", "add", "adi", *([] if SENSORS else ["vsd"]), "mssd", "mspd", "cus", "proj"],
    }
    for modality, sensor in [(m, s) for s in SENSORS for m in ("rgb", "depth")] or [("", "")]:
        params.update(paths(os.path.join(path, "{scene_id:06d}"), modality, sensor))
    return params


def paths(scene, modality, sensor):
    """Path templates; in the layout of several sensors with modality and sensor in their keys."""
    key, end = (f"_{modality}_{sensor}", f"_{sensor}") if sensor else ("", "")
    files = {f"{name}{key}_tpath": f"{name}{end}.json" for name in ("scene_camera", "scene_gt", "scene_gt_info", "scene_gt_coco")}
    files |= {f"{name}{key}_tpath": f"{name}{end}/{{im_id:06d}}_{{gt_id:06d}}.png" for name in ("mask", "mask_visib")}
    images = {modality: RGB_EXT if modality == "rgb" else ".png"} if sensor else {"rgb": RGB_EXT, "gray": RGB_EXT, "depth": ".png"}
    files |= {f"{name}{end}_tpath": f"{name}{end}/{{im_id:06d}}{suffix}" for name, suffix in images.items()}
    return {name: os.path.join(scene, *file.split("/")) for name, file in files.items()}


def model_params(datasets_path, model_type):
    """As get_model_params of the toolkit."""
    models = os.path.join(datasets_path, NAME, "models" if model_type is None else f"models_{model_type}")
    return {
        "obj_ids": OBJ_IDS,
        "symmetric_obj_ids": SYMMETRIC_OBJ_IDS,
        "model_tpath": os.path.join(models, "obj_{obj_id:06d}.ply"),
        "models_info_path": os.path.join(models, "models_info.json"),
    }


def camera_params(datasets_path):
    """As get_camera_params of the toolkit."""
    path = os.path.join(datasets_path, NAME, "camera.json")
    return {"cam_params_path": path, **toolkit.inout.load_cam_params(path)}


def extend(function, ours):
    """The toolkit's function, with this data set besides those it knows."""
    return lambda datasets_path, name, *args, **kwargs: (ours if name == NAME else function)(datasets_path, name, *args, **kwargs)


toolkit.get_split_params = extend(
    toolkit.get_split_params, lambda datasets_path, name, split, split_type=None: split_params(datasets_path, split, split_type)
)
toolkit.get_model_params = extend(
    toolkit.get_model_params, lambda datasets_path, name, model_type=None: model_params(datasets_path, model_type)
)
toolkit.get_camera_params = extend(toolkit.get_camera_params, lambda datasets_path, name, cam_type=None: camera_params(datasets_path))
'''

_ONE_SIZE = '{sensor: IM_SIZE for sensor in ("", *SENSORS)} if SENSORS else IM_SIZE'
"""Expression of the body for images of one size."""
_BOTH = '{sensor: ["rgb", "depth"] for sensor in SENSORS} or ["rgb", "depth"]'
"""Expression of the body for images of both kinds from all sensors; also in its loop over these."""
_PAIRS = '[(m, s) for s in SENSORS for m in ("rgb", "depth")]'
_EVAL_SENSOR = '"eval_sensor": SENSORS[0]'


def format_dataset_params(settings: ExportSettings, catalog: Catalog, cameras: tuple[Camera, ...]) -> str:
    """Text of bop_dataset_params.py: Python that adds the data set to the toolkit's functions."""
    layout, rig, entries = settings.layout, settings.rig, catalog.entries
    values: dict[str, Any] = {
        "SPLITS": list(layout.folders),
        "SENSORS": list(layout.sensors),
        "OBJ_IDS": [entry.obj_id for entry in entries],
        "SYMMETRIC_OBJ_IDS": [entry.obj_id for entry in entries if entry.symmetries_discrete or entry.symmetries_continuous],
        "IM_SIZE": cameras[0].resolution,
        "RGB_EXT": f".{settings.bop.color_format}",
    }
    sizes = {sensor: camera.resolution for sensor, camera in zip(layout.sensors, cameras, strict=False)}
    body = _BODY
    kinds = [[name for name, kind in (("rgb", COLOR), ("depth", DEPTH)) if rig.writes(camera, kind)] for camera in range(len(rig))]
    if any(own != ["rgb", "depth"] for own in kinds):
        values["MODALITIES"] = dict(zip(layout.sensors, kinds, strict=True)) if layout.sensors else kinds[0]
        body = body.replace(_BOTH, "MODALITIES").replace(_PAIRS, "[(m, s) for s in SENSORS for m in MODALITIES[s]]")
        body = body.replace(_EVAL_SENSOR, '"eval_sensor": next((s for s in SENSORS if "rgb" in MODALITIES[s]), SENSORS[0])')
    if len(set(sizes.values())) > 1:
        values["IM_SIZE"], body = {"": values["IM_SIZE"], **sizes}, _BODY.replace(_ONE_SIZE, "IM_SIZE")
    return _HEAD + "\n".join(f"{name} = {value!r}" for name, value in values.items()) + "\n" + body


def describe_toolkit(layout: DataLayout) -> str:
    """Section of dataset_info.md: how to use the toolkit's scripts with this data set."""
    folder = next((name for name in layout.folders if name.startswith("test")), layout.folders[0])
    split, _, kind = folder.partition("_")
    options = f"--dataset synpick --dataset_split {split}" + (f" --dataset_split_type {kind}" if kind else "")
    ending = f"{split}-{kind}" if kind else split
    meaning = f"`{split}`" + (f" of the type `{kind}`" if kind else "")
    sensors = (
        f"\nScripts evaluate the sensor {layout.sensors[0]}; for another one, put it first in `SENSORS` of `bop_dataset_params.py`. "
        "VSD, and so\n"
        "`eval_bop19_pose.py`, is not computed for data sets of several sensors; `eval_bop24_pose.py` is.\n"
        if layout.has_sensors
        else ""
    )
    return f"""
## With the BOP toolkit

The toolkit knows data sets by name, which is the name of their folder in `BOP_PATH`: letters and digits only. Work **on a copy**, with
masks of its own: `calc_gt_masks.py`, `calc_gt_info.py` and `calc_gt_coco.py` overwrite the exact masks and annotations of this folder.

```bash
export BOP_PATH=/path/to/bop                      # folder of data sets
cp -r /path/to/this/folder $BOP_PATH/synpick
cd bop_toolkit
echo "import runpy; runpy.run_path('$BOP_PATH/synpick/{PARAMS_FILE}')" >> bop_toolkit_lib/dataset_params.py
sed -i 's/"vsd_deltas": {{/&"synpick": 15, /' scripts/eval_bop19_pose.py scripts/eval_calc_errors.py
unset DISPLAY; export PYOPENGL_PLATFORM=egl                 # without a display
export EGL_PLATFORM=surfaceless                             # and without a GPU: Mesa's EGL on the CPU
python scripts/calc_gt_coco.py {options}
python scripts/eval_bop24_pose.py --renderer_type=vispy --result_filenames=METHOD_synpick-{ending}.csv
```

A result file is called METHOD_synpick-{ending}.csv: BOP's folder `{folder}` is the split {meaning}, joined by
hyphens there. `--targets_filename` names another list than that of the test split.
{sensors}"""
