"""Files of a BOP dataset that all scenes share: models with sizes and symmetries, camera.json, notes for humans, the entry for the BOP
toolkit, which has no registry; and evaluation target lists, from the committed scenes of the splits."""

import json
import re
import shutil
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from synpick_warp.configs.cell.cameras import COLOR, DEPTH
from synpick_warp.configs.dataset import DataLayout, ExportSettings, split_kind
from synpick_warp.errors import CatalogError, DatasetError
from synpick_warp.exporters.bop.view import MILLIMETERS
from synpick_warp.exporters.writing.files import join_lines, write_atomically
from synpick_warp.exporters.writing.notes import describe_lenses, describe_sizes
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.scenes.assets.appearance import decode_texture, tint
from synpick_warp.scenes.assets.asset_files import MissingFileError, quiet_decoding
from synpick_warp.scenes.assets.models_info import corrected_entry, read_entries
from synpick_warp.scenes.assets.ply import read_ply_file, read_ply_texture
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry
from synpick_warp.system.hardware.cores import map_in_threads
from synpick_warp.system.inputs.files import make_folder, path_inside, read_json
from synpick_warp.system.inputs.image_files import TEXTURE_KINDS
from synpick_warp.views.layer_codec import layer_notes

MODEL_FOLDERS = ("models", "models_eval")
"""The toolkit renders the first and evaluates with the second; ours are equal."""


def write_models(catalog: Catalog, *folders: Path, mechanics: bool = False) -> None:
    """Write the PLY file and texture of each object, and models_info.json, into each folder; existing folders are replaced.

    Models read from BOP files are copied byte for byte. So are their entries in models_info.json, if these agree with the meshes' sizes.
    `mechanics`: whether entries also have the keys of `make_mechanics`. Raises CatalogError: a model file or its texture has changed
    since it was read.
    """
    for folder in folders:
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir()
    infos = {}
    with quiet_decoding():  # Around the threads, too: filters of warnings are the process's, and each thread restores what it found.
        files = map_in_threads(_make_files, catalog.entries)
    for entry, (model, texture) in zip(catalog.entries, files, strict=True):
        for path in (folder / f"obj_{entry.obj_id:06d}.ply" for folder in folders):
            if texture is not None:
                _write_texture(path, entry.source or path, *texture)
            path.write_bytes(model)
        known = read_entries(entry.source.parent / "models_info.json") if entry.source else None
        info = corrected_entry((known or {}).get(str(entry.obj_id)), make_model_info(entry))
        infos[str(entry.obj_id)] = info | make_mechanics(entry) if mechanics else info
    for folder in folders:
        (folder / "models_info.json").write_text(json.dumps(infos, indent=2) + "\n", encoding="ascii")


def encode_model(entry: CatalogEntry) -> bytes:
    """Encode an object as binary PLY in millimetres, with the property types that the BOP toolkit reads.

    Of a textured object with texture coordinates and the name of the texture, obj_ID.png; else with the material's colour at every vertex.
    """
    mesh, textured = entry.mesh, entry.material.texture is not None
    names = ["x", "y", "z", "nx", "ny", "nz", *(("texture_u", "texture_v") if textured else ())]
    fields: list[tuple[str, str]] = [(name, "<f4") for name in names]
    properties = [f"property float {name}" for name in names]
    if not textured:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), np.dtype(fields))
    columns = np.concatenate((MILLIMETERS * mesh.vertices.astype(np.float64), mesh.normals, mesh.uv), axis=1)
    for index, name in enumerate(names):
        vertices[name] = columns[:, index]
    if not textured:
        for name, value in zip(("red", "green", "blue"), entry.material.color, strict=True):
            vertices[name] = round(255 * value)
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("indices", "<i4", 3)]))
    faces["count"], faces["indices"] = 3, mesh.faces
    header = (
        "ply",
        "format binary_little_endian 1.0",
        f"comment {entry.name}, millimetres",
        *((f"comment TextureFile obj_{entry.obj_id:06d}.png",) if textured else ()),
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    )
    return "".join(line + "\n" for line in header).encode() + vertices.tobytes() + faces.tobytes()


def make_model_info(entry: CatalogEntry) -> dict[str, Any]:
    """Entry of an object in models_info.json [mm]."""
    low, high = (MILLIMETERS * extremum(entry.mesh.vertices.astype(np.float64), axis=0) for extremum in (np.min, np.max))
    info: dict[str, Any] = {"diameter": MILLIMETERS * entry.diameter}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    info |= {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
    if entry.material.transmission > 0.0:
        info["transmission"] = entry.material.transmission
    if entry.symmetries_discrete:
        info["symmetries_discrete"] = [
            # Row-major 4 x 4 matrices, of which the translation is a length.
            [MILLIMETERS * value if index in (3, 7, 11) else value for index, value in enumerate(matrix)]
            for matrix in entry.symmetries_discrete
        ]
    if entry.symmetries_continuous:
        info["symmetries_continuous"] = [
            {"axis": list(axis), "offset": [MILLIMETERS * value for value in offset]} for axis, offset in entry.symmetries_continuous
        ]
    return info


def make_mechanics(entry: CatalogEntry) -> dict[str, Any]:
    """Keys of an object in models_info.json for manipulation: mass [kg], centre of mass [mm], inertia about it (row by row) [kg·mm²], and
    the area on which a suction cup seals [mm²], with its fraction of the surface, if measured."""
    center, inertia = MILLIMETERS * entry.center_of_mass, MILLIMETERS**2 * entry.inertia
    info: dict[str, Any] = {"mass": entry.mass, "center_of_mass": center.tolist(), "inertia": inertia.ravel().tolist()}
    if entry.suctionable is not None:
        area, fraction = entry.suctionable
        info |= {"suctionable_area": MILLIMETERS**2 * area, "suctionable_fraction": fraction}
    return info


def _make_files(entry: CatalogEntry) -> tuple[bytes, tuple[str, bytes] | None]:
    """Contents of an object's PLY file, and name and contents of its texture file (None: it has no texture). They are those of the source
    files; embedded objects, and models whose texture was missing, are encoded anew. Raises CatalogError: the texture has changed or is
    missing now."""
    source, texture, name = entry.source, entry.material.texture, f"obj_{entry.obj_id:06d}.png"
    if source is None:
        return encode_model(entry), None if texture is None else (name, encode_png(tint(texture, entry.material.color)))
    data = read_ply_file(source)
    try:
        found = read_ply_texture(data, source)
    except MissingFileError:
        if texture is not None:
            raise
        return encode_model(entry), None  # The copy would name a texture that is not there.
    if found is not None and not np.array_equal(decode_texture(found[1], str(source.parent / found[0])), np.asarray(texture)):
        raise CatalogError(f"{source}: its texture {found[0]} changed since it was read; start again")
    return data, found


def _write_texture(path: Path, source: Path, name: str, image: bytes) -> None:
    """Write a texture beside the PLY file `path`. Raises CatalogError: its name is not allowed or that of another file of the set."""
    target = path_inside(path.parent, name, source, CatalogError)
    if target.suffix[1:].lower() not in TEXTURE_KINDS or any(part.startswith(".") for part in Path(name).parts):
        kinds = ", .".join(TEXTURE_KINDS)
        raise CatalogError(f"{source} names the texture {name}; allowed: names without leading dots that end in .{kinds}; rename it")
    if target.exists() and target.read_bytes() != image:
        raise CatalogError(f"{source} names the texture {name}, but the set has another file of that name; rename it")
    make_folder(target.parent)
    target.write_bytes(image)


def describe_dataset(settings: ExportSettings, catalog: Catalog, cameras: tuple[Camera, ...]) -> str:
    """Text of dataset_info.md: conventions of the ground truth, and the objects."""
    layout, period = settings.layout, settings.physics.tick_time
    objects = "\n".join(f"| {entry.obj_id} | {entry.name} | {entry.mass:g} |" for entry in catalog.entries)
    pictures = describe_sizes(layout, cameras)
    folders = ", ".join(f"`{split.folder}/` (k from {split.first} on)" for split in layout.splits) or f"`{layout.split}/`"
    scenes = f"Camera c of episode k is scene {layout.cameras} · k + c"
    if layout.has_sensors:
        sensors = layout.sensors
        names = f"{sensors[0]} to {sensors[-1]}" if sensors[0] == "cam0" else ", ".join(sensors)
        scenes = f"Episode k is scene k, with files of the sensors {names},"
    return f"""# A SynPick data set
{describe_lenses(settings)}
Made by synpick-warp (mode {", ".join(settings.modes)}, seed {settings.bake.seed}, {layout.cameras} cameras), in the format of the
BOP challenge (scenewise). {scenes} of {folders}. Frames are {period:g} s apart.

- Lengths are in millimetres. A depth image's count times `depth_scale` ({settings.bop.depth_scale:g}) is the planar depth, along the
  optical axis; 0: no surface.
- Pictures have {pictures}. The centre of pixel (row, column) is (column + 0.5, row + 0.5): for OpenCV and
  Open3D, whose pixel centres have whole coordinates, subtract 0.5 from cx and cy. Cameras have x right, y down, z forward.
- `cam_R_w2c` and `cam_t_w2c` lead from the {settings.bins[0].noun}'s frame (centre of its inner floor, z up) to the camera.
- `light` in scene_camera.json describes the episode's light: the map's name, its yaw [rad], the exposure relative to the automatic
  one [EV], and the direction to the sun or lamp that casts shadows, in the {settings.bins[0].noun}'s frame; null if none is dominant.
  `effects`, if present, has the parameters of the camera effects on colour; `config.toml` has the ranges from which they were sampled.
- `instance_id` in scene_gt.json is an object's number for the whole episode, the same for all cameras; a gt_id is only the position
  in an image's list.
- `mask_visib` is exact: what the ray through the pixel's centre meets first. The masks of an image do not overlap.
- `px_count_all` and `bbox_obj` count what lies outside of the picture too, up to one picture's size beyond each border.
{layer_notes(settings.render.layers)}- `models_eval/` equals `models/`.

| obj_id | name | mass [kg] |
|---|---|---|
{objects}
{describe_toolkit(layout)}"""


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


BOP19, BOP24, MULTIVIEW = "test_targets_bop19.json", "test_targets_bop24.json", "test_targets_multiview_bop25.json"
_SCENE = re.compile(r"[0-9]{6,12}")
"""Name of a scene's folder."""
_Frame = Annotated[str, msgspec.Meta(pattern=r"\A(0|[1-9][0-9]{0,8})\Z")]
"""Key of a frame in a scene's JSON files."""
_ADVICE = "remove the scene and its episode's two files in manifest/, and resume the bake"


class _Truth(msgspec.Struct):
    """Schema of an instance in scene_gt.json, as far as targets need it: obj_id."""

    obj_id: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class _Info(msgspec.Struct):
    """Schema of an instance in scene_gt_info.json, as far as targets need it: visible fraction."""

    visib_fract: float


def sensor_suffixes(layout: DataLayout) -> tuple[str, ...]:
    """Suffixes of the sensors' files in a scene; one empty string in the classic layout."""
    return tuple(layout.scene(0, camera)[1] for camera in range(layout.cameras)) if layout.has_sensors else ("",)


def _kinds(layout: DataLayout) -> tuple[str, ...]:
    """Kinds of target lists; the multi-view one only with several sensors in a scene."""
    return (BOP19, BOP24, *((MULTIVIEW,) if layout.has_sensors else ()))


def scene_target_files(layout: DataLayout, folder: str) -> tuple[str, ...]:
    """Names of a split's target lists (BOP19, BOP24, and MULTIVIEW with several sensors), by the split's kind.

    Without splits, all scenes are in the lists named test, which the toolkit's scripts open for any split.

    Lists begin with the kind of their splits, as in val_targets_bop19.json; splits of one kind share them, as scene ids are unique.
    """
    kind = split_kind(folder) if layout.splits else "test"
    return tuple(name.replace("test", kind, 1) for name in _kinds(layout))


def target_files(layout: DataLayout) -> tuple[str, ...]:
    """All files that list targets. Those named test always exist, as BOP's toolkit opens them for any split."""
    return tuple(dict.fromkeys((*_kinds(layout), *(name for folder in layout.folders for name in scene_target_files(layout, folder)))))


def find_scenes(split: Path, scenes: Collection[int]) -> list[Path]:
    """Find the scene folders in a split's folder, sorted; other names and links are left out."""
    places = (path for path in split.iterdir() if _SCENE.fullmatch(path.name) and int(path.name) in scenes)
    return sorted(path for path in places if path.is_dir() and not path.is_symlink())


def write_scene_targets(scene: Path, folders: tuple[str, ...], visibility: float, sensors: tuple[str, ...] = ("",)) -> None:
    """Task: write a scene's targets (`make_scene_targets`) under its name into a folder for each list."""
    for folder, lines in zip(folders, make_scene_targets(scene, visibility, sensors), strict=False):
        Path(folder, scene.name).write_bytes(lines)


def make_scene_targets(scene: Path, visibility: float, sensors: tuple[str, ...]) -> Iterator[bytes]:
    """Yield a scene's targets, one per line, for each list: BOP19, BOP24, MULTIVIEW.

    BOP19: for each image and object, the number of instances of at least `visibility` (fraction), if any. BOP24: every image. Of several
    sensors, both list the images of the first, by which the toolkit evaluates. MULTIVIEW: the images of all sensors at a time.
    """
    truths, details = (path_inside(scene, f"scene_{name}{sensors[0]}.json", scene, DatasetError) for name in ("gt", "gt_info"))
    truth = read_json(truths, dict[_Frame, list[_Truth]], DatasetError, _ADVICE)
    infos = read_json(details, dict[_Frame, list[_Info]], DatasetError, _ADVICE)
    if {frame: len(entries) for frame, entries in truth.items()} != {frame: len(entries) for frame, entries in infos.items()}:
        raise DatasetError(f"{scene} has other objects in scene_gt.json than in scene_gt_info.json; {_ADVICE}")
    scene_id = int(scene.name)
    localize, detect, together = [], [], []
    for frame in sorted(truth, key=int):
        visible = Counter(entry.obj_id for entry, info in zip(truth[frame], infos[frame], strict=True) if info.visib_fract >= visibility)
        image = {"im_id": int(frame)}
        localize += [{**image, "inst_count": count, "obj_id": obj_id, "scene_id": scene_id} for obj_id, count in sorted(visible.items())]
        detect.append({**image, "scene_id": scene_id})
        together.append({"im_id": [[sensor.removeprefix("_"), int(frame)] for sensor in sensors], "scene_id": scene_id})
    for targets in (localize, detect, together):
        yield "".join(json.dumps(target) + "\n" for target in targets).encode()


def concatenate_targets(folder: Path, out: Path, names: tuple[str, ...]) -> None:
    """Concatenate the parts in `folder/name`, of a scene or of many, into the data set's files, in order of their numbers."""
    for name in names:
        parts = sorted((folder / name).iterdir(), key=lambda path: int(path.name))
        write_atomically(out / name, join_lines(parts, b"[", b"]\n"))
