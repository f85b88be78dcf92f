"""Faults to plant in a copy of a correct data set: each a function of its folder, with the rule that must find it and words of the message."""

from __future__ import annotations

import json
import os
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SCENE = "train/000001"
FAULTS: list[Fault] = []


@dataclass(frozen=True)
class Fault:
    """A fault."""

    rule: str
    """Rule that must find it."""
    words: str
    """Part of the message."""
    plant: Callable[[Path], None]

    @property
    def name(self) -> str:
        """Name of the test."""
        return self.plant.__name__


def fault(rule: str, words: str = "") -> Callable[[Callable[[Path], None]], Callable[[Path], None]]:
    """Declare the decorated function as one that plants a fault."""

    def declare(plant: Callable[[Path], None]) -> Callable[[Path], None]:
        FAULTS.append(Fault(rule, words, plant))
        return plant

    return declare


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    """Change a JSON file in place."""
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def edit_entry(folder: Path, name: str, index: int | None = None, image: str = "1", **values: Any) -> None:
    """Set keys of an entry in a scene's JSON file."""

    def change(content: Any) -> None:
        entry = content[image] if index is None else content[image][index]
        entry.update(values)

    edit(folder / SCENE / f"scene_{name}.json", change)


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)


def mask_path(folder: Path, index: int, kind: str = "mask", image: int = 1) -> Path:
    return folder / SCENE / kind / f"{image:06d}_{index:06d}.png"


@fault("link-outside")
def link_out_of_the_set(folder):
    os.symlink(folder.parent, folder / "models" / "elsewhere")


@fault("scene-links")
def link_image_out_of_the_set(folder):
    outside = folder.parent / "secret.png"
    outside.write_bytes((folder / SCENE / "rgb/000001.png").read_bytes())
    (folder / SCENE / "rgb/000001.png").unlink()
    os.symlink(outside, folder / SCENE / "rgb/000001.png")


@fault("split-folders", "no scene")
def stray_folder_in_split(folder):
    (folder / "train/backup").mkdir()


@fault("split-folders", "4 digits")
def short_scene_name(folder):
    (folder / "train/000002").rename(folder / "train/0002")


@fault("camera-file", "fx")
def camera_without_focal_length(folder):
    edit(folder / "camera.json", lambda content: {key: value for key, value in content.items() if key != "fx"})


@fault("set-files", "toolkit")
def no_targets(folder):
    (folder / "test_targets_bop19.json").unlink()


@fault("scene-files")
def no_scene_camera(folder):
    (folder / SCENE / "scene_camera.json").unlink()


@fault("ground-truth")
def no_infos(folder):
    (folder / SCENE / "scene_gt_info.json").unlink()


@fault("image-names")
def odd_file_name(folder):
    (folder / SCENE / "rgb/1.png").write_bytes((folder / SCENE / "rgb/000001.png").read_bytes())


@fault("image-missing")
def missing_depth(folder):
    (folder / SCENE / "depth/000001.png").unlink()


@fault("image-missing")
def missing_mask(folder):
    mask_path(folder, 2).unlink()


@fault("image-extra", "no instance 7")
def mask_beyond_the_list(folder):
    mask_path(folder, 7).write_bytes(mask_path(folder, 0).read_bytes())


@fault("image-extra", "no entry 9")
def image_without_entry(folder):
    (folder / SCENE / "rgb/000009.png").write_bytes((folder / SCENE / "rgb/000001.png").read_bytes())


@fault("json-schema")
def translation_of_two_numbers(folder):
    edit_entry(folder, "gt", 0, cam_t_m2c=[1.0, 2.0])


@fault("json-keys", "leading zeros")
def padded_key(folder):
    edit(folder / SCENE / "scene_gt.json", lambda content: {f"{int(key):06d}": value for key, value in content.items()})


@fault("same-images")
def image_without_truth(folder):
    edit(folder / SCENE / "scene_gt.json", lambda content: {"0": content["0"]})


@fault("rotation", "determinant is -1")
def mirrored_rotation(folder):
    edit_entry(folder, "gt", 1, cam_R_m2c=[1, 0, 0, 0, 1, 0, 0, 0, -1])


@fault("rotation", "cam_R_w2c")
def scaled_rotation(folder):
    edit_entry(folder, "camera", cam_R_w2c=[1.01, 0, 0, 0, 1, 0, 0, 0, 1])


@fault("camera-model", "both")
def two_camera_models(folder):
    edit_entry(folder, "camera", cam_model={"projection_params": [1.0]})


@fault("camera-model", "column by column")
def transposed_intrinsics(folder):
    edit_entry(folder, "camera", cam_K=[600.0, 0, 0, 0, 600.0, 0, 100.0, 75.0, 1])


@fault("depth-scale")
def no_depth_scale(folder):
    edit(folder / SCENE / "scene_camera.json", lambda content: content["1"].pop("depth_scale") and None)


@fault("skip-translation")
def translation_of_minus_one(folder):
    edit_entry(folder, "gt", 1, cam_t_m2c=[-1, -1, -1])


@fault("translation-units", "metres")
def pose_in_metres(folder):
    def change(content):
        for item in content["1"]:
            item["cam_t_m2c"] = [value / 1000.0 for value in item["cam_t_m2c"]]

    edit(folder / SCENE / "scene_gt.json", change)


@fault("camera-units", "metres")
def camera_in_metres(folder):
    def change(content):
        for item in content.values():
            item["cam_t_w2c"] = [value / 1000.0 for value in item["cam_t_w2c"]]

    edit(folder / SCENE / "scene_camera.json", change)


@fault("extrinsics")
def half_of_the_extrinsics(folder):
    edit(folder / SCENE / "scene_camera.json", lambda content: content["1"].pop("cam_t_w2c") and None)


@fault("behind-camera")
def opengl_pose(folder):
    def change(content):
        x, y, z = content["1"][0]["cam_t_m2c"]
        content["1"][0]["cam_t_m2c"] = [x, -y, -z]

    edit(folder / SCENE / "scene_gt.json", change)


@fault("instance-ids", "2 times")
def instance_twice(folder):
    edit_entry(folder, "gt", 0, instance_id=3)


@fault("object-model", "obj_id 99")
def unknown_object(folder):
    edit_entry(folder, "gt", 0, obj_id=99)


@fault("list-lengths")
def short_infos(folder):
    edit(folder / SCENE / "scene_gt_info.json", lambda content: content["1"].pop() and None)


@fault("visible-fraction")
def wrong_fraction(folder):
    edit_entry(folder, "gt_info", 0, visib_fract=0.5)


@fault("count-order")
def counts_in_the_wrong_order(folder):
    edit_entry(folder, "gt_info", 0, px_count_all=10)


@fault("hidden-boxes")
def zero_box_of_a_visible_instance(folder):
    edit_entry(folder, "gt_info", 0, bbox_visib=[-1, -1, -1, -1])


@fault("box-inside-box")
def box_reaches_out(folder):
    edit_entry(folder, "gt_info", 0, bbox_visib=[0, 0, 199, 149])


@fault("image-decodes")
def truncated_image(folder):
    path = folder / SCENE / "rgb/000001.png"
    path.write_bytes(path.read_bytes()[:100])


@fault("image-size", "100 x 75")
def small_depth(folder):
    path = folder / SCENE / "depth/000001.png"
    write(path, read(path)[::2, ::2])


@fault("colour-type", "1 channels")
def grey_rgb(folder):
    path = folder / SCENE / "rgb/000001.png"
    write(path, read(path)[..., 0])


@fault("depth-type", "8 bits")
def depth_of_eight_bits(folder):
    path = folder / SCENE / "depth/000001.png"
    write(path, (read(path) // 256).astype(np.uint8))


@fault("depth-known")
def empty_depth(folder):
    path = folder / SCENE / "depth/000001.png"
    write(path, 0 * read(path))


@fault("mask-type", "values")
def mask_of_ones(folder):
    write(mask_path(folder, 1), read(mask_path(folder, 1)) // 255)


@fault("mask-type", "RGB")
def mask_in_colour(folder):
    write(mask_path(folder, 1), cv2.cvtColor(read(mask_path(folder, 1)), cv2.COLOR_GRAY2BGR))


@fault("mask-inside-mask")
def visible_beyond_the_silhouette(folder):
    visible = read(mask_path(folder, 1, "mask_visib"))
    visible[:5, :5] = 255
    write(mask_path(folder, 1, "mask_visib"), visible)


@fault("mask-overlap")
def amodal_masks_as_visible_ones(folder):
    for index in range(2):
        write(mask_path(folder, index, "mask_visib"), read(mask_path(folder, index)))
        write(mask_path(folder, index, "mask_visib"), read(mask_path(folder, 1)) | read(mask_path(folder, index, "mask_visib")))


@fault("visible-count")
def wrong_visible_count(folder):
    edit_entry(folder, "gt_info", 0, px_count_visib=3000)


@fault("valid-count")
def wrong_valid_count(folder):
    edit_entry(folder, "gt_info", 0, px_count_valid=1000)


@fault("amodal-count")
def wrong_amodal_count(folder):
    edit_entry(folder, "gt_info", 2, px_count_all=9000)


@fault("visible-box", "+ 1")
def visible_box_with_one_more(folder):
    def change(content):
        content["1"][0]["bbox_visib"][2] += 1
        content["1"][0]["bbox_visib"][3] += 1

    edit(folder / SCENE / "scene_gt_info.json", change)


@fault("amodal-box", "+ 1")
def amodal_box_with_one_more(folder):
    def change(content):
        content["1"][2]["bbox_obj"][2] += 1
        content["1"][2]["bbox_obj"][3] += 1

    edit(folder / SCENE / "scene_gt_info.json", change)


def edit_coco(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    edit(folder / SCENE / "scene_gt_coco.json", change)


@fault("coco-schema")
def coco_without_categories(folder):
    edit_coco(folder, lambda content: content.pop("categories") and None)


@fault("coco-ids", "id 0")
def coco_ids_from_zero(folder):
    edit_coco(folder, lambda content: [item.update(id=item["id"] - 1) for item in content["annotations"]] and None)


@fault("coco-images", "file_name")
def coco_wrong_file_name(folder):
    edit_coco(folder, lambda content: content["images"][0].update(file_name="000000.png"))


@fault("coco-categories")
def coco_categories_from_one(folder):
    edit_coco(folder, lambda content: content.update(categories=[{"id": 1, "name": "1"}]))


@fault("coco-instances")
def coco_annotation_missing(folder):
    edit_coco(folder, lambda content: content["annotations"].pop() and None)


@fault("coco-mask", "row by row")
def coco_row_major(folder):
    def change(content):
        for item in content["annotations"]:
            runs = item["segmentation"]
            height, width = runs["size"]
            flat = np.repeat(np.arange(len(runs["counts"])) % 2, runs["counts"]).reshape(width, height).T.reshape(-1)
            edges = np.flatnonzero(np.diff(flat)) + 1
            runs["counts"] = np.diff(np.concatenate(([0], edges, [height * width]))).tolist()

    edit_coco(folder, change)


@fault("coco-box", "+ 1")
def coco_box_without_one(folder):
    def change(content):
        x, y, width, height = content["annotations"][0]["bbox"]
        content["annotations"][0]["bbox"] = [x, y, width - 1, height - 1]

    edit_coco(folder, change)


@fault("coco-ignore")
def coco_ignores_visible(folder):
    edit_coco(folder, lambda content: content["annotations"][0].update(ignore=True))


@fault("model-files", "no model")
def model_missing(folder):
    (folder / "models_eval/obj_000007.ply").unlink()


@fault("model-dialect", "float32")
def model_of_other_types(folder):
    path = folder / "models/obj_000007.ply"
    path.write_bytes(path.read_bytes().replace(b"property float ", b"property float32 "))


@fault("model-mesh")
def model_cut_short(folder):
    path = folder / "models/obj_000007.ply"
    path.write_bytes(path.read_bytes()[:-40])


def edit_model(folder: Path, **values: Any) -> None:
    edit(folder / "models/models_info.json", lambda content: content["7"].update(values))


@fault("model-entry")
def model_without_diameter(folder):
    edit(folder / "models/models_info.json", lambda content: content["7"].pop("diameter") and None)


@fault("model-diameter", "metres")
def diameter_in_metres(folder):
    edit_model(folder, diameter=0.21213)


@fault("model-box", "size_z")
def wrong_model_size(folder):
    edit_model(folder, size_z=100.0)


@fault("symmetry-identity")
def identity_listed(folder):
    edit_model(folder, symmetries_discrete=[np.eye(4).ravel().tolist()])


@fault("symmetry-rigid")
def mirror_symmetry(folder):
    edit_model(folder, symmetries_discrete=[np.diag([-1.0, 1.0, 1.0, 1.0]).ravel().tolist()])


@fault("symmetry-maps")
def false_symmetry(folder):
    edit_model(folder, symmetries_discrete=[[0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 0, 1]])


@fault("target-schema")
def targets_are_no_list(folder):
    (folder / "test_targets_bop19.json").write_text("{}")


@fault("target-scenes", "scene 77")
def target_of_another_scene(folder):
    edit(folder / "test_targets_bop19.json", lambda content: content[0].update(scene_id=77))


@fault("target-images", "image 50")
def target_of_another_image(folder):
    edit(folder / "test_targets_bop19.json", lambda content: content[0].update(im_id=50))


@fault("target-counts")
def wrong_target_count(folder):
    edit(folder / "test_targets_bop19.json", lambda content: content[0].update(inst_count=9))


@fault("rig-complete")
def camera_missing(folder):
    (folder / "train/000002").rename(folder / "gone")


@fault("world-poses", "mm")
def camera_moved(folder):
    edit_entry(folder, "camera", cam_t_w2c=[0.0, 0.0, 1490.0])


@fault("shard-index", "no shard-000000.tar")
def shard_missing(folder):
    (folder / "train_web/shard-000000.tar").unlink()


@fault("shard-files")
def shard_cut_short(folder):
    path = folder / "train_web/shard-000000.tar"
    path.write_bytes(path.read_bytes()[:5000])


@fault("mask-entries")
def shard_without_a_mask(folder):
    path, kept = folder / "train_web/shard-000000.tar", []
    with tarfile.open(path) as tar:
        for member in tar.getmembers():
            data = tar.extractfile(member).read()
            if member.name == "000000_000001.mask.json":
                data = json.dumps({key: value for key, value in json.loads(data).items() if key != "1"}).encode()
            member.size = len(data)
            kept.append((member, data))
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for member, data in kept:
            import io

            tar.addfile(member, io.BytesIO(data))


def scale_depth(folder: Path, factor: float) -> None:
    for path in (folder / SCENE / "depth").iterdir():
        write(path, np.rint(read(path) * factor).astype(np.uint16))


@fault("depth-scaled", "1.02 times")
def depth_scaled_up(folder):
    scale_depth(folder, 1.02)


@fault("depth-scaled", "0.99 times")
def depth_scaled_down(folder):
    scale_depth(folder, 0.99)


@fault("depth-planar")
def depth_of_rays(folder):
    content = json.loads((folder / SCENE / "scene_camera.json").read_text())["1"]["cam_K"]
    for path in (folder / SCENE / "depth").iterdir():
        depth = read(path)
        x = (np.arange(depth.shape[1]) + 0.5 - content[2]) / content[0]
        y = (np.arange(depth.shape[0]) + 0.5 - content[5]) / content[4]
        write(path, np.rint(depth * np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2)).astype(np.uint16))


@fault("mask-shifted", "(3, 0)")
def masks_shifted(folder):
    for kind in ("mask", "mask_visib"):
        for path in (folder / SCENE / kind).glob("*_000001.png"):
            write(path, np.roll(read(path), 3, axis=1))


@fault("mask-shifted", "(0, -1)")
def mask_shifted_by_one_pixel(folder):
    write(mask_path(folder, 1), np.roll(read(mask_path(folder, 1)), -1, axis=0))


@fault("instances-swapped", "instances 0 and 2")
def masks_swapped(folder):
    for kind in ("mask", "mask_visib"):
        one, two = mask_path(folder, 0, kind), mask_path(folder, 2, kind)
        first, second = one.read_bytes(), two.read_bytes()
        one.write_bytes(second)
        two.write_bytes(first)


@fault("instances-swapped", "instances 0 and 1")
def truths_swapped(folder):
    def change(content):
        content["1"][0], content["1"][1] = content["1"][1], content["1"][0]

    edit(folder / SCENE / "scene_gt.json", change)


@fault("pose", "about")
def pose_moved_sideways(folder):
    def change(content):
        content["1"][0]["cam_t_m2c"][0] += 12.0

    edit(folder / SCENE / "scene_gt.json", change)


@fault("pose", "about 8 mm")
def pose_moved_away(folder):
    def change(content):
        content["1"][2]["cam_t_m2c"][2] -= 8.0

    edit(folder / SCENE / "scene_gt.json", change)


@fault("pose", "does not fit")
def pose_turned(folder):
    def change(content):
        turn = np.array([[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]])
        rotation = turn @ np.reshape(content["1"][2]["cam_R_m2c"], (3, 3))
        content["1"][2]["cam_R_m2c"] = rotation.ravel().tolist()

    edit(folder / SCENE / "scene_gt.json", change)


@fault("mask-rendered")
def mask_of_a_box(folder):
    mask = read(mask_path(folder, 1))
    x, y, width, height = cv2.boundingRect(mask)
    mask[y : y + height, x : x + width] = 255
    write(mask_path(folder, 1), mask)


@fault("visible-rendered")
def half_of_the_visible_mask(folder):
    visible = read(mask_path(folder, 0, "mask_visib"))
    visible[:, : int(np.flatnonzero(visible.any(axis=0)).mean())] = 0
    write(mask_path(folder, 0, "mask_visib"), visible)


@fault("depth-rendered")
def depth_of_something_else(folder):
    path = folder / SCENE / "depth/000001.png"
    depth, visible = read(path), read(mask_path(folder, 0, "mask_visib")) > 0
    visible[: int(np.flatnonzero(visible.any(axis=1)).mean()) + 5] = False
    depth[visible] -= 300
    write(path, depth)
