"""Faults of images, masks and COCO files; see `planting`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.validation.planting import SCENE, edit, edit_entry, fault, mask_path, read, write


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
