"""Faults to plant in a copy of a correct data set: the rule that must find each, words of its message, and how it is planted. Plants are
functions of the set's folder that edit annotations, images, masks or bytes."""

import io
import json
import os
import tarfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import trimesh

from synpick_warp.codes import Outcome, Share
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.dataset.reading import open_data_set
from synpick_warp.exporters.picks import make_table, pick_files
from synpick_warp.views.picks import COLUMNS
from tests.harness.hostile import removed, replaced

SCENE = "train/000001"
GT, INFO, CAMERA, COCO = (f"{SCENE}/scene_{name}.json" for name in ("gt", "gt_info", "camera", "gt_coco"))
MODELS, TARGETS, SHARD = "models/models_info.json", "test_targets_bop19.json", "train_web/shard-000000.tar"
Plant = Callable[[Path], Any]


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    """Change a JSON file in place."""
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def edit_entry(folder: Path, name: str, index: int | None = None, image: str = "1", **values: Any) -> None:
    """Set keys of an entry in a scene's JSON file."""
    edit(folder / SCENE / f"scene_{name}.json", lambda content: (content[image] if index is None else content[image][index]).update(values))


def whole(name: str, change: Callable[[Any], Any]) -> Plant:
    """A JSON file's content is changed in place or, if the change returns something, replaced."""
    return lambda folder: edit(folder / name, change)


def put(name: str, *place: Any) -> Plant:
    """The last of the arguments stands at the place that the others name."""
    return whole(name, lambda content: replaced(content, place[:-1], place[-1]))


def moved(name: str, *place: Any) -> Plant:
    """A number at a place of a JSON file is larger by the last argument; numbers in a list, each."""

    def add(content: Any) -> Any:
        value = content
        for key in place[:-1]:
            value = value[key]
        return replaced(content, place[:-1], np.add(value, place[-1]).tolist())

    return whole(name, add)


def drop(name: str, *place: Any) -> Plant:
    """A JSON file lacks what stands at a place."""
    return whole(name, lambda content: removed(content, place))


def gone(name: str) -> Plant:
    """A file is missing."""
    return lambda folder: (folder / name).unlink()


def named(name: str, other: str) -> Plant:
    """A file or folder has another name."""
    return lambda folder: (folder / name).rename(folder / other)


def doubled(name: str, other: str) -> Plant:
    """A file is there twice."""
    return lambda folder: (folder / other).write_bytes((folder / name).read_bytes())


def raw(name: str, change: Callable[[bytes], bytes]) -> Plant:
    """A file has other bytes."""
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def trials(change: Callable[[np.ndarray], Any]) -> Plant:
    """The trials of picks are changed in place or, if the change returns some, replaced."""

    def damage(folder: Path) -> None:
        path, rows = folder / pick_files(0)[0], open_data_set(folder)[0].picks
        changed = change(rows)
        pq.write_table(make_table(COLUMNS, rows if changed is None else changed), path)

    return damage


def pixels(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Images of scene 1 whose names fit the pattern have other pixels; a change in place returns the image, too."""

    def plant(folder: Path) -> None:
        paths = list((folder / SCENE).glob(name))
        assert paths
        for path in paths:
            write(path, change(read(path)))

    return plant


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)


def mask_path(folder: Path, index: int, kind: str = "mask") -> Path:
    return folder / SCENE / kind / f"000001_{index:06d}.png"


# ---- the faults ----

Faults = dict[str, tuple[str, str, Plant]]
RGB, DEPTH, MASK, VISIBLE = "rgb/000001.png", "depth/000001.png", "mask/000001_000001.png", "mask_visib/000001_000001.png"
PLY, SEEN = "models/obj_000007.ply", "mask_visib/000001_000000.png"


def link_image_out_of_the_set(folder: Path) -> None:
    outside = (folder / SCENE / RGB).rename(folder.parent / "secret.png")
    os.symlink(outside, folder / SCENE / RGB)


def scaled(entries: Iterable[dict[str, Any]], key: str, *factors: float) -> None:
    """A vector of each entry is scaled."""
    for item in entries:
        item[key] = np.multiply(item[key], factors).tolist()


FILES: Faults = {
    "link out of the set": ("link-outside", "", lambda folder: os.symlink(folder.parent, folder / "models" / "elsewhere")),
    "image is a link out of the set": ("scene-links", "", link_image_out_of_the_set),
    "stray folder in split": ("split-folders", "no scene", lambda folder: (folder / "train/backup").mkdir()),
    "short scene name": ("split-folders", "4 digits", named("train/000002", "train/0002")),
    "camera without focal length": ("camera-file", "fx", drop("camera.json", "fx")),
    "no targets": ("set-files", "toolkit", gone(TARGETS)),
    "bake interrupted": ("bake-finished", "", gone("manifest/joined.json")),
    "model missing for evaluation": ("set-files", "this object", gone("models_eval/obj_000007.ply")),
    "no scene camera": ("scene-files", "", gone(CAMERA)),
    "no infos": ("ground-truth", "", gone(INFO)),
    "odd file name": ("image-names", "", doubled(f"{SCENE}/{RGB}", f"{SCENE}/rgb/1.png")),
    "missing depth": ("image-missing", "", gone(f"{SCENE}/{DEPTH}")),
    "missing mask": ("image-missing", "", gone(f"{SCENE}/mask/000001_000002.png")),
    "mask beyond the list": ("image-extra", "no instance 7", doubled(f"{SCENE}/{MASK}", f"{SCENE}/mask/000001_000007.png")),
    "image without entry": ("image-extra", "no entry 9", doubled(f"{SCENE}/{RGB}", f"{SCENE}/rgb/000009.png")),
}


def with_graph(order: list[int], support: list[list[float]]) -> Plant:
    """Image 1 has a scene graph, whose order begins with some instances."""

    def plant(folder: Path) -> None:
        rest = sorted(set(range(len(json.loads((folder / GT).read_text())["1"]))) - set(order))
        entry = {"occlusion": [], "support": support, "order": [[index] for index in (*order, *rest)]}
        (folder / SCENE / "scene_graph.json").write_text(json.dumps({"1": entry}))

    return plant


def carried_from_afar(folder: Path) -> None:
    """Two instances rest in both images, 2 m from each other, and one carries the other."""
    whole(GT, lambda content: [item.update(cam_t_m2c=[2e3 * index, 0.0, 1e3]) for index, item in enumerate(content["1"])] and None)(folder)
    whole(GT, lambda content: content.update({"0": content["1"]}))(folder)
    with_graph([0, 1], [[0, 1, 2.5]])(folder)


ANNOTATIONS: Faults = {
    "translation of two numbers": ("json-schema", "", put(GT, "1", 0, "cam_t_m2c", [1.0, 2.0])),
    "padded key": ("json-keys", "leading zeros", whole(GT, lambda content: {f"{int(key):06d}": value for key, value in content.items()})),
    "image without truth": ("same-images", "", whole(GT, lambda content: {"0": content["0"]})),
    "mirrored rotation": ("rotation", "determinant is -1", put(GT, "1", 1, "cam_R_m2c", [1, 0, 0, 0, 1, 0, 0, 0, -1])),
    "scaled rotation": ("rotation", "cam_R_w2c", put(CAMERA, "1", "cam_R_w2c", [1.01, 0, 0, 0, 1, 0, 0, 0, 1])),
    "two camera models": ("camera-model", "both", put(CAMERA, "1", "cam_model", {"projection_params": [1.0]})),
    "transposed intrinsics": ("camera-model", "column by column", put(CAMERA, "1", "cam_K", [600.0, 0, 0, 0, 600.0, 0, 100.0, 75.0, 1])),
    "no depth scale": ("depth-scale", "", drop(CAMERA, "1", "depth_scale")),
    "translation of minus one": ("skip-translation", "", put(GT, "1", 1, "cam_t_m2c", [-1, -1, -1])),
    "pose in metres": ("translation-units", "metres", whole(GT, lambda content: scaled(content["1"], "cam_t_m2c", 1e-3))),
    "camera in metres": ("camera-units", "metres", whole(CAMERA, lambda content: scaled(content.values(), "cam_t_w2c", 1e-3))),
    "half of the extrinsics": ("extrinsics", "", drop(CAMERA, "1", "cam_t_w2c")),
    "OpenGL pose": ("behind-camera", "", whole(GT, lambda content: scaled(content["1"][:1], "cam_t_m2c", 1.0, -1.0, -1.0))),
    "instance twice": ("instance-ids", "2 times", put(GT, "1", 0, "instance_id", 3)),
    "unknown object": ("object-model", "obj_id 99", put(GT, "1", 0, "obj_id", 99)),
    "short infos": ("list-lengths", "", drop(INFO, "1", -1)),
    "wrong fraction": ("visible-fraction", "", put(INFO, "1", 0, "visib_fract", 0.5)),
    "counts in the wrong order": ("count-order", "", put(INFO, "1", 0, "px_count_all", 10)),
    "zero box of a visible instance": ("hidden-boxes", "", put(INFO, "1", 0, "bbox_visib", [-1, -1, -1, -1])),
    "graph of strangers": ("scene-graph", "above", with_graph([9], [])),
    "taken from below": ("scene-graph", "1 comes before 0, which it carries", with_graph([1, 0], [[0, 1, 2.5]])),
    "carried from afar": ("support-touches", "instance 1 carries 0, but is", carried_from_afar),
    "box reaches out": ("box-inside-box", "", put(INFO, "1", 0, "bbox_visib", [0, 0, 199, 149])),
}


def fill(image: np.ndarray, where: tuple[slice, slice], value: int) -> np.ndarray:
    image[where] = value
    return image


def amodal_masks_as_visible_ones(folder: Path) -> None:
    first, second = (read(mask_path(folder, index)) for index in (0, 1))
    for index, image in ((0, first | second), (1, second)):
        write(mask_path(folder, index, "mask_visib"), image)


def row_major(content: dict[str, Any]) -> None:
    for item in content["annotations"]:
        runs = item["segmentation"]
        height, width = runs["size"]
        flat = np.repeat(np.arange(len(runs["counts"])) % 2, runs["counts"]).reshape(width, height).T.reshape(-1)
        edges = np.flatnonzero(np.diff(flat)) + 1
        runs["counts"] = np.diff(np.concatenate(([0], edges, [height * width]))).tolist()


ids_from_zero = whole(COCO, lambda content: [item.update(id=item["id"] - 1) for item in content["annotations"]] and None)
IMAGES: Faults = {
    "truncated image": ("image-decodes", "", raw(f"{SCENE}/{RGB}", lambda data: data[:100])),
    "small depth": ("image-size", "100 x 75", pixels(DEPTH, lambda image: image[::2, ::2])),
    "grey rgb": ("colour-type", "1 channels", pixels(RGB, lambda image: image[..., 0])),
    "depth of eight bits": ("depth-type", "8 bits", pixels(DEPTH, lambda image: (image // 256).astype(np.uint8))),
    "empty depth": ("depth-known", "", pixels(DEPTH, lambda image: 0 * image)),
    "mask of ones": ("mask-type", "values", pixels(MASK, lambda image: image // 255)),
    "mask in colour": ("mask-type", "RGB", pixels(MASK, lambda image: cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))),
    "visible beyond the silhouette": ("mask-inside-mask", "", pixels(VISIBLE, lambda image: fill(image, np.s_[:5, :5], 255))),
    "amodal masks as visible ones": ("mask-overlap", "", amodal_masks_as_visible_ones),
    "wrong visible count": ("visible-count", "", put(INFO, "1", 0, "px_count_visib", 3000)),
    "wrong valid count": ("valid-count", "", put(INFO, "1", 0, "px_count_valid", 1000)),
    "wrong amodal count": ("amodal-count", "", put(INFO, "1", 2, "px_count_all", 9000)),
    "visible box with one more": ("visible-box", "+ 1", moved(INFO, "1", 0, "bbox_visib", [0, 0, 1, 1])),
    "amodal box with one more": ("amodal-box", "+ 1", moved(INFO, "1", 2, "bbox_obj", [0, 0, 1, 1])),
    "COCO without categories": ("coco-schema", "", drop(COCO, "categories")),
    "COCO ids from zero": ("coco-ids", "id 0", ids_from_zero),
    "COCO wrong file name": ("coco-images", "file_name", put(COCO, "images", 0, "file_name", "000000.png")),
    "COCO categories from one": ("coco-categories", "", put(COCO, "categories", [{"id": 1, "name": "1"}])),
    "COCO annotation missing": ("coco-instances", "", drop(COCO, "annotations", -1)),
    "COCO row major": ("coco-mask", "row by row", whole(COCO, row_major)),
    "COCO box without one": ("coco-box", "+ 1", moved(COCO, "annotations", 0, "bbox", [0, 0, -1, -1])),
    "COCO ignores visible": ("coco-ignore", "", put(COCO, "annotations", 0, "ignore", True)),
}


def move_model(scale: float, shift: float) -> Plant:
    def plant(folder: Path) -> None:
        for path in (folder / PLY, folder / "models_eval/obj_000007.ply"):
            mesh = trimesh.load_mesh(path, process=False)
            mesh.vertices = scale * mesh.vertices + shift
            path.write_bytes(mesh.export(file_type="ply"))

    return plant


def symmetry(*matrix: float) -> Plant:
    return whole(MODELS, lambda content: content["7"].update(symmetries_discrete=[list(matrix)]))


def camera_turned(content: dict[str, Any]) -> None:
    """The camera is turned by 90° about its optical axis."""
    right, down, forward = np.reshape(content["1"]["cam_R_w2c"], (3, 3)).tolist()
    content["1"]["cam_R_w2c"] = [*(-value for value in down), *right, *forward]


def shard_without_a_mask(folder: Path) -> None:
    path, kept = folder / SHARD, []
    with tarfile.open(path) as tar:
        for member in tar.getmembers():
            data = tar.extractfile(member).read()
            if member.name == "000000_000001.mask.json":
                data = json.dumps({key: value for key, value in json.loads(data).items() if key != "1"}).encode()
            member.size = len(data)
            kept.append((member, data))
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for member, data in kept:
            tar.addfile(member, io.BytesIO(data))


SETS: Faults = {
    "model missing": ("model-files", "no model", gone("models_eval/obj_000007.ply")),
    "model of other types": ("model-dialect", "float32", raw(PLY, lambda data: data.replace(b"property float ", b"property float32 "))),
    "model cut short": ("model-mesh", "", raw(PLY, lambda data: data[:-40])),
    "model without diameter": ("model-entry", "", drop(MODELS, "7", "diameter")),
    "diameter in metres": ("model-diameter", "metres", put(MODELS, "7", "diameter", 0.21213)),
    "wrong model size": ("model-box", "size_z", put(MODELS, "7", "size_z", 100.0)),
    "model in metres": ("model-units", "metres", move_model(1e-3, 0.0)),
    "model off its origin": ("model-origin", "", move_model(1.0, 60.0)),
    "identity listed": ("symmetry-identity", "", symmetry(*np.eye(4).ravel().tolist())),
    "mirror symmetry": ("symmetry-rigid", "", symmetry(*np.diag([-1.0, 1.0, 1.0, 1.0]).ravel().tolist())),
    "false symmetry": ("symmetry-maps", "", symmetry(0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 0, 1)),
    "targets are no list": ("target-schema", "", raw(TARGETS, lambda _: b"{}")),
    "target of another scene": ("target-scenes", "scene 77", put(TARGETS, 0, "scene_id", 77)),
    "target of another image": ("target-images", "image 50", put(TARGETS, 0, "im_id", 50)),
    "wrong target count": ("target-counts", "", put(TARGETS, 0, "inst_count", 9)),
    "camera missing": ("rig-complete", "", named("train/000002", "gone")),
    "camera moved": ("world-poses", "mm", put(CAMERA, "1", "cam_t_w2c", [0.0, 0.0, 1490.0])),
    "camera turned": ("world-poses", " mm and 90° off", whole(CAMERA, camera_turned)),
    "shard missing": ("shard-index", "no shard-000000.tar", gone(SHARD)),
    "shard cut short": ("shard-files", "", raw(SHARD, lambda data: data[:5000])),
    "shard without a mask": ("mask-entries", "", shard_without_a_mask),
}


def scale_depth(factor: float) -> Plant:
    return pixels("depth/*", lambda image: np.rint(image * factor).astype(np.uint16))


def depth_of_rays(folder: Path) -> None:
    fx, _, cx, _, fy, cy, *_ = json.loads((folder / CAMERA).read_text())["1"]["cam_K"]

    def lengthen(depth: np.ndarray) -> np.ndarray:
        x, y = ((np.arange(size) + 0.5 - c) / f for size, c, f in ((depth.shape[1], cx, fx), (depth.shape[0], cy, fy)))
        return np.rint(depth * np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2)).astype(np.uint16)

    pixels("depth/*", lengthen)(folder)


def swap(entries: Any, first: Any, second: Any, key: str = "") -> None:
    """Swap two entries, or what they have at a key."""
    if key:
        entries[first][key], entries[second][key] = entries[second][key], entries[first][key]
    else:
        entries[first], entries[second] = entries[second], entries[first]


def masks_swapped(folder: Path) -> None:
    for kind in ("mask", "mask_visib"):
        paths = [mask_path(folder, index, kind) for index in (0, 2)]
        for path, data in zip(paths, [path.read_bytes() for path in paths][::-1], strict=True):
            path.write_bytes(data)


def turn(content: dict[str, Any]) -> None:
    about_z = np.array([[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]])
    content["1"][2]["cam_R_m2c"] = (about_z @ np.reshape(content["1"][2]["cam_R_m2c"], (3, 3))).ravel().tolist()


def half_of_a_mask(mask: np.ndarray) -> np.ndarray:
    return fill(mask, np.s_[:, : int(np.flatnonzero(mask.any(axis=0)).mean())], 0)


def mask_of_a_box(mask: np.ndarray) -> np.ndarray:
    x, y, width, height = cv2.boundingRect(mask)
    return fill(mask, np.s_[y : y + height, x : x + width], 255)


def depth_of_something_else(folder: Path) -> None:
    visible = read(mask_path(folder, 0, "mask_visib")) > 0
    visible[: int(np.flatnonzero(visible.any(axis=1)).mean()) + 5] = False
    pixels(DEPTH, lambda depth: depth - 300 * visible.astype(np.uint16))(folder)


def other_outcome(folder: Path) -> None:
    """The own grasp of the episode's attempt is dropped, on the same path."""
    path = folder / "config.toml"
    same = load_config(str(path), {"picks.near": 0.0, "picks.hold": 0.0, "picks.lift_height": 1.0})
    path.write_text(config_to_toml(same))

    def change(rows: np.ndarray) -> None:
        first = int(np.flatnonzero((rows["frame"] == 1) & (rows["instance"] == 2))[0])
        rows["share"][first], rows["point"][first], rows["outcome"][first] = Share.OWN, (0.1, 0.2, 0.3), Outcome.DROPPED

    trials(change)(folder)


def put_value(rows: np.ndarray, column: str, value: Any, where: str = "") -> None:
    """Set a column of the first trial and its repeats, or of the first where another column is not 0."""
    first = int(np.flatnonzero(rows[where])[0]) if where else 0
    rows[column][(rows["state"] == rows["state"][first]) & (rows["candidate"] == rows["candidate"][first])] = value


RENDERED: Faults = {
    "depth scaled up": ("depth-scaled", "1.02 times", scale_depth(1.02)),
    "depth scaled down": ("depth-scaled", "0.99 times", scale_depth(0.99)),
    "depth of rays": ("depth-planar", "", depth_of_rays),
    "masks shifted": ("mask-shifted", "(3, 0)", pixels("mask*/*_000001.png", lambda image: np.roll(image, 3, axis=1))),
    "mask shifted by one pixel": ("mask-shifted", "(0, -1)", pixels(MASK, lambda image: np.roll(image, -1, axis=0))),
    "visible masks shifted": ("mask-shifted", "mask_visib is shifted by (4, 0)", pixels(SEEN, lambda image: np.roll(image, 4, axis=1))),
    "object ids swapped": ("object-shown", "object 7", whole(GT, lambda content: swap(content["1"], 1, 2, "obj_id"))),
    "masks swapped": ("instances-swapped", "instances 0 and 2", masks_swapped),
    "truths swapped": ("instances-swapped", "instances 0 and 1", whole(GT, lambda content: swap(content["1"], 0, 1))),
    "pose moved sideways": ("pose", "about", moved(GT, "1", 0, "cam_t_m2c", [12.0, 0.0, 0.0])),
    "pose moved away": ("pose", "about 8 mm", moved(GT, "1", 2, "cam_t_m2c", [0.0, 0.0, -8.0])),
    "pose turned": ("pose", "does not fit", whole(GT, turn)),
    "mask of a box": ("mask-rendered", "", pixels(MASK, mask_of_a_box)),
    "half of the visible mask": ("visible-rendered", "", pixels(SEEN, half_of_a_mask)),
    "depth of something else": ("depth-rendered", "", depth_of_something_else),
}
PICKS: Faults = {
    "table cut": ("picks-tables", "cannot be read", raw("picks/000000.parquet", lambda data: data[:-5])),
    "frame of a trial": ("picks-tables", "column frame, row 0 is 1; allowed: the fr", trials(lambda rows: put_value(rows, "frame", 1))),
    "trials of a candidate gone": ("picks-tables", "row 0 is 12; allowed: 11, which", trials(lambda rows: rows[rows["candidate"] > 0])),
    "normal too long": ("picks-tables", "allowed: a unit vector", trials(lambda rows: put_value(rows, "normal", (0.0, 0.0, 2.0)))),
    "seal above 1": ("picks-tables", "row 0 is 1.5; allowed: 0 to 1", trials(lambda rows: put_value(rows, "seal", 1.5))),
    "pixel beside": ("picks-pixels", "not project to its pixel", trials(lambda rows: put_value(rows, "column", rows["column"][0] + 1))),
    "point above the surface": ("picks-surface", "from the surf", trials(lambda rows: put_value(rows, "point", rows["point"][0] + 0.02))),
    "other instance": ("picks-surface", "from the surface of its instance", trials(lambda rows: put_value(rows, "instance", 3))),
    "hidden instance": ("picks-pixels", "does not show its instance", trials(lambda rows: put_value(rows, "instance", 3))),
    "other object": ("picks-surface", "not an object of that obj_id", trials(lambda rows: put_value(rows, "obj_id", 7))),
    "success without outcome": ("picks-outcomes", "success does not agree", trials(lambda rows: put_value(rows, "outcome", 4, "success"))),
    "moved nothing": ("picks-outcomes", "moved and farthest do not agree", trials(lambda rows: put_value(rows, "moved", 2))),
    "own grasp of another attempt": ("picks-own", "chose another grasp", trials(lambda rows: put_value(rows, "share", 0, "frame"))),
    "own grasp with another outcome": ("picks-own", "its outcome is dropped, that of attempt 0 is target_picked", other_outcome),
    "own grasp of no attempt": ("picks-own", "no attempt chose from frame 0", trials(lambda rows: put_value(rows, "share", 0))),
}
FAULTS = FILES | ANNOTATIONS | IMAGES | SETS | PICKS | RENDERED
