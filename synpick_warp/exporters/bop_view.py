"""One view as BOP has it: its picture files, and its records of camera, poses, counts and boxes.

Runs in writer processes, so it imports neither Warp nor Newton. Millimetres exist in the BOP exporter alone.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from synpick_warp.exporters.png import encode_mask_png, encode_png
from synpick_warp.exporters.rle import Crop, amodal_crop, run_lengths, visible_crop
from synpick_warp.layers import encode_layer, layer_path

RECORDS = "records"
"""Folder of views' records, in a scene that is not whole yet."""
MILLIMETERS = 1000.0
"""In a metre."""
IGNORE_VISIBILITY = 0.1
"""COCO annotations less visible are to be ignored (the toolkit's calc_gt_coco.py)."""
NO_BOX = [-1, -1, -1, -1]
"""What the toolkit writes for an instance of which nothing is visible (calc_gt_info.py)."""
_ALL, _VALID, _VISIBLE = 0, 1, 2
"""Columns of `FrameBatch.pixels`."""
_WHOLE, _SEEN = 0, 1
"""Rows of `FrameBatch.boxes`."""


@dataclass(frozen=True)
class ViewSettings:
    """What all views of a camera share."""

    color_suffix: str
    masks: bool
    coco: bool
    camera: dict[str, Any]
    """The record in scene_camera.json."""


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Ground truth of a view: its row of `FrameBatch`, of instances that exist."""

    frame: int
    jpeg_quality: int
    circumstances: dict[str, Any]
    """What the view adds to its record in scene_camera.json."""
    instance_id: np.ndarray
    """(N)"""
    object_id: np.ndarray
    """(N)"""
    pose: np.ndarray
    """(N, 7)"""
    pixels: np.ndarray
    """(N, 3)"""
    boxes: np.ndarray
    """(N, 2, 4)"""


def write_view(
    color: np.ndarray, depth: np.ndarray, instance: np.ndarray, amodal: np.ndarray, scene: Path, settings: ViewSettings, truth: ViewTruth
) -> None:
    """Write a view's pictures into the folders of a scene, and its records, one a line, into `RECORDS`.

    Lines: scene_camera, scene_gt, scene_gt_info, then one COCO annotation each, without its id.
    """
    name = f"{truth.frame:06d}"
    (scene / "rgb" / f"{name}{settings.color_suffix}").write_bytes(_encode_color(color, settings, truth.jpeg_quality))
    (scene / "depth" / f"{name}.png").write_bytes(encode_png(depth))
    height, width = depth.shape
    infos, annotations = [], []
    for index, instance_id in enumerate(truth.instance_id.tolist()):
        whole = amodal_crop(amodal, instance_id, truth.boxes[index, _WHOLE])
        seen = visible_crop(instance, instance_id, truth.boxes[index, _SEEN])
        if settings.masks:
            (scene / "mask" / f"{name}_{index:06d}.png").write_bytes(encode_mask_png(whole, height, width))
            (scene / "mask_visib" / f"{name}_{index:06d}.png").write_bytes(encode_mask_png(seen, height, width))
        info = info_record(truth.pixels[index], truth.boxes[index])
        infos.append(info)
        if settings.coco and (annotation := coco_record(truth.frame, int(truth.object_id[index]), info, whole, seen, height, width)):
            annotations.append(annotation)
    lines = (settings.camera | truth.circumstances, gt_records(truth, settings.camera), infos, *annotations)
    (scene / RECORDS / name).write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="ascii")


def write_layer(values: np.ndarray, scene: Path, name: str, frame: int) -> None:
    """Write a view's layer into the folder of that name."""
    layer_path(scene, name, frame).write_bytes(encode_png(encode_layer(name, values)))


def _encode_color(color: np.ndarray, settings: ViewSettings, jpeg_quality: int) -> bytes:
    if settings.color_suffix == ".png":
        return encode_png(color)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, jpeg_quality))
    if not done:
        raise ValueError(f"OpenCV cannot encode a picture of shape {color.shape} as JPEG")
    return data.tobytes()


def gt_records(truth: ViewTruth, camera: dict[str, Any]) -> list[dict[str, Any]]:
    """The view's entry in scene_gt.json: model to camera, in float64 from the world pose [mm]."""
    rotation = np.reshape(camera["cam_R_w2c"], (3, 3))
    translation = np.asarray(camera["cam_t_w2c"])
    pose = truth.pose.astype(np.float64)
    model = rotation @ rotation_matrices(pose[:, 3:])
    place = MILLIMETERS * pose[:, :3] @ rotation.T + translation
    return [
        {
            "cam_R_m2c": model[index].ravel().tolist(),
            "cam_t_m2c": place[index].tolist(),
            "obj_id": int(truth.object_id[index]),
            "instance_id": int(truth.instance_id[index]),
        }
        for index in range(len(truth.instance_id))
    ]


def rotation_matrices(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of quaternions x, y, z, w (N, 4) float64 of any length but zero."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def info_record(pixels: np.ndarray, boxes: np.ndarray) -> dict[str, Any]:
    """An instance's entry in scene_gt_info.json. Boxes may exceed the image; a box of one pixel has width and height 0."""
    whole, valid, visible = (int(pixels[column]) for column in (_ALL, _VALID, _VISIBLE))
    return {
        "bbox_obj": _extent(boxes[_WHOLE]) if visible else NO_BOX,
        "bbox_visib": _extent(boxes[_SEEN]) if visible else NO_BOX,
        "px_count_all": whole,
        "px_count_valid": valid,
        "px_count_visib": visible,
        "visib_fract": visible / whole if whole else 0.0,
    }


def _extent(box: np.ndarray) -> list[int]:
    x_min, y_min, x_max, y_max = box.tolist()
    return [x_min, y_min, x_max - x_min, y_max - y_min]


def coco_record(
    frame: int, object_id: int, info: dict[str, Any], whole: Crop, seen: Crop, height: int, width: int
) -> dict[str, Any] | None:
    """An instance's annotation, without id: amodal box clipped to the image, visible mask; None if there is nothing to see."""
    box = whole.box()
    area = seen.count
    if box is None or not area:
        return None
    x_min, y_min, x_max, y_max = box
    return {
        "image_id": frame,
        "category_id": object_id,
        "iscrowd": 0,
        "area": area,
        "bbox": [x_min, y_min, x_max - x_min + 1, y_max - y_min + 1],
        "segmentation": {"counts": run_lengths(seen, height, width), "size": [height, width]},
        "width": width,
        "height": height,
        "ignore": info["visib_fract"] < IGNORE_VISIBILITY,
    }
