"""One view as BOP has it: its picture files, and its records of camera, poses, counts and boxes.

Runs in writer processes, so it imports neither Warp nor Newton. Millimetres exist in the BOP exporter alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson

from synpick_warp.codes import Effect, names
from synpick_warp.exporters.writing.folder import Buffer, open_folder
from synpick_warp.exporters.writing.png import encode_mask_png, encode_png
from synpick_warp.exporters.writing.rle import Runs, find_run_boundaries, unpack_run_boundaries
from synpick_warp.frames import FrameBatch
from synpick_warp.layer_codec import encode_layer, layer_path
from synpick_warp.scenes.types import Camera

ANNOTATIONS = "records"
"""File of views' records, in a scene that is not whole yet, in the order in which they came; see `annotation_block`. It is one file, not
one a view, because ext4 without a journal walks over the inodes that were freed in the last minutes whenever it makes a file.
"""
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
_DIGITS = 6
"""Decimal places of what is told of light and camera."""
JPEG_QUALITY = "jpeg_quality"
"""The `Effect` that is the writer's to make."""


@dataclass(frozen=True)
class ViewSettings:
    """What all views of a camera share."""

    color_suffix: str
    jpeg_quality: int
    """Unless the view has its own, see `effects`."""
    effects: tuple[str, ...]
    """The effects that are on."""
    masks: bool
    coco: bool
    camera: dict[str, Any]
    """What all views' records in scene_camera.json share."""


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Ground truth of a view: its row of `FrameBatch`, of instances that exist."""

    scene: int
    """Number of the scene."""
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
    listed: bool
    """The last two arrays of the view's task are lists of run boundaries, not images."""
    top: int
    """Row of the picture with which these images begin."""
    left: int
    """Column of the picture with which they begin."""


@dataclass(frozen=True, eq=False)
class Masks:
    """Of one instance."""

    whole: Runs
    """Its silhouette, hidden or not, inside the picture."""
    seen: Runs
    """Its visible part."""


def shared_record(camera: Camera, depth_scale: float) -> dict[str, Any]:
    """What the entries of all views of a camera in scene_camera.json share."""
    return {
        "cam_K": camera.matrix.ravel().tolist(),
        "cam_R_w2c": camera.rotation.ravel().tolist(),
        "cam_t_w2c": (MILLIMETERS * camera.translation).tolist(),
        "depth_scale": depth_scale,
    }


def make_view_task(batch: FrameBatch, view: int, scene: int, settings: ViewSettings) -> tuple[tuple[np.ndarray, ...], ViewTruth]:
    """What a task on one view needs: color, depth, two arrays that hold where masks begin and end, and the truth.

    The two are the lists of run boundaries of the images instance and amodal, or else the images themselves, cut to where objects are.
    """
    present = np.flatnonzero(batch.object_id[view] >= 0)
    boxes = batch.boxes[view][present]
    boundaries = _boundaries(batch, view)
    rows, columns = (slice(0, 0), slice(0, 0)) if boundaries else _shown(boxes, *batch.depth.shape[1:])
    strengths: dict[str, float] = dict(zip(names(Effect), batch.effects[view].tolist(), strict=True))
    truth = ViewTruth(
        scene=scene,
        frame=int(batch.frame[view]),
        jpeg_quality=round(strengths[JPEG_QUALITY]) if JPEG_QUALITY in settings.effects else settings.jpeg_quality,
        circumstances=_circumstances(batch, view, {name: strengths[name] for name in settings.effects}),
        instance_id=present,
        object_id=batch.object_id[view][present],
        pose=batch.pose[view][present],
        pixels=batch.pixels[view][present],
        boxes=boxes,
        listed=bool(boundaries),
        top=rows.start,
        left=columns.start,
    )
    masks = boundaries or tuple(image[view, rows, columns] for image in (batch.instance, batch.amodal))
    return (batch.color[view], batch.depth[view], *masks), truth


def _circumstances(batch: FrameBatch, view: int, effects: dict[str, float]) -> dict[str, Any]:
    """A view's light, and what its camera did to colour if that is anything, for scene_camera.json."""
    direction = batch.light_direction[view]
    light = {
        "map": str(batch.light_name[view]),
        "turn": round(float(batch.light_yaw[view]), _DIGITS),
        "exposure": round(float(batch.light_exposure[view]), _DIGITS),
        "direction": [round(part, _DIGITS) for part in direction.tolist()] if direction.any() else None,
    }
    return {"light": light} | ({"effects": {name: round(value, _DIGITS) for name, value in effects.items()}} if effects else {})


def _boundaries(batch: FrameBatch, view: int) -> tuple[np.ndarray, ...]:
    """Lists of the run boundaries of instance and amodal, if they are there, complete, and not larger than the images."""
    if batch.boundaries is None or batch.boundary_count is None or (batch.boundary_count[view] > batch.boundaries.shape[-1]).any():
        return ()
    counts = batch.boundary_count[view].tolist()
    lists = tuple(packed[:, :count] for packed, count in zip(batch.boundaries[view], counts, strict=True))
    images = batch.instance[view], batch.amodal[view]
    return lists if all(packed.nbytes <= image.nbytes for packed, image in zip(lists, images, strict=True)) else ()


def _shown(boxes: np.ndarray, height: int, width: int) -> tuple[slice, slice]:
    """Rows and columns of the picture that hold what all boxes (N, 2, 4) hold of it."""
    whole = boxes[:, _WHOLE][boxes[:, _WHOLE, 2] >= boxes[:, _WHOLE, 0]]
    left, top = (min(max(int(whole[:, edge].min(initial=size)), 0), size) for edge, size in ((0, width), (1, height)))
    right, bottom = (min(1 + int(whole[:, edge].max(initial=-1)), size) for edge, size in ((2, width), (3, height)))
    return slice(top, max(top, bottom)), slice(left, max(left, right))


def extract_masks(first: np.ndarray, second: np.ndarray, truth: ViewTruth, height: int) -> list[Masks]:
    """Masks of all instances, in their order, from the last two arrays of `make_view_task`."""
    seen, whole = (
        unpack_run_boundaries(array, height) if truth.listed else find_run_boundaries(array, truth.top, truth.left)
        for array in (first, second)
    )
    return [Masks(whole.runs_with(number), seen.runs_of(1 + number)) for number in truth.instance_id.tolist()]


def write_view(
    color: np.ndarray, depth: np.ndarray, first: np.ndarray, second: np.ndarray, scene: Path, settings: ViewSettings, truth: ViewTruth
) -> None:
    """Write what `make_view_task` gave: pictures into the folders of a scene, and records into `ANNOTATIONS`.

    Lines: scene_camera, scene_gt, scene_gt_info, then one COCO annotation each, without its id.
    """
    name = f"{truth.frame:06d}"
    height, width = depth.shape
    with open_folder(scene) as folder:
        folder.write(f"rgb/{name}{settings.color_suffix}", encode_color(color, settings, truth.jpeg_quality))
        folder.write(f"depth/{name}.png", encode_png(depth))
        masks = extract_masks(first, second, truth, height) if settings.masks or settings.coco else []
        if settings.masks:
            for index, mask in enumerate(masks):
                whole, seen = encode_masks(mask, height, width)
                folder.write(f"mask/{name}_{index:06d}.png", whole)
                folder.write(f"mask_visib/{name}_{index:06d}.png", seen)
        infos = info_records(truth)
        lines = [camera_record(truth, settings), gt_records(truth, settings.camera), infos]
        if settings.coco:
            lines += coco_records(truth, infos, masks, height, width)
        folder.append(ANNOTATIONS, annotation_block(truth.frame, map(to_json, lines)))


def annotation_block(frame: int, records: Iterable[bytes]) -> bytes:
    """A view's records as `ANNOTATIONS` has them: a line with the frame and the length of each record [B], then the records, one a line."""
    lines = tuple(records)
    return b"\n".join((b" ".join(b"%d" % number for number in (frame, *map(len, lines))), *lines, b""))


def write_layer(values: np.ndarray, scene: Path, name: str, frame: int) -> None:
    """Write a view's layer into the folder of that name."""
    layer_path(scene, name, frame).write_bytes(encode_png(encode_layer(name, values)))


def encode_color(color: np.ndarray, settings: ViewSettings, jpeg_quality: int) -> Buffer:
    """A picture (H, W, 3) uint8, red first, in the format that the settings name."""
    if settings.color_suffix == ".png":
        return encode_png(color)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, jpeg_quality))
    if not done:
        raise ValueError(f"OpenCV cannot encode a picture of shape {color.shape} as JPEG")
    return data.data


def encode_masks(masks: Masks, height: int, width: int) -> tuple[bytes, bytes]:
    """PNG files of an instance's two masks. Often nothing hides it: then both are the same."""
    whole = encode_mask_png(masks.whole, height, width)
    return whole, whole if masks.whole.count == masks.seen.count else encode_mask_png(masks.seen, height, width)


def to_json(record: object) -> bytes:
    """A record in one line of JSON; arrays become lists."""
    return orjson.dumps(record, option=orjson.OPT_SERIALIZE_NUMPY)


def camera_record(truth: ViewTruth, settings: ViewSettings) -> dict[str, Any]:
    """A view's entry in scene_camera.json."""
    return settings.camera | truth.circumstances


def gt_records(truth: ViewTruth, camera: dict[str, Any]) -> list[dict[str, Any]]:
    """The view's entry in scene_gt.json: model to camera, in float64 from the world pose [mm]."""
    rotation = np.reshape(camera["cam_R_w2c"], (3, 3))
    translation = np.asarray(camera["cam_t_w2c"])
    pose = truth.pose.astype(np.float64)
    model = (rotation @ rotation_matrices(pose[:, 3:])).reshape(-1, 9)
    place = MILLIMETERS * pose[:, :3] @ rotation.T + translation
    rows = zip(*(array.tolist() for array in (model, place, truth.object_id, truth.instance_id)), strict=True)
    return [dict(zip(("cam_R_m2c", "cam_t_m2c", "obj_id", "instance_id"), row, strict=True)) for row in rows]


def rotation_matrices(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of quaternions x, y, z, w (N, 4) float64 of any length but zero."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def info_records(truth: ViewTruth) -> list[dict[str, Any]]:
    """The view's entry in scene_gt_info.json. Boxes may exceed the image; a box of one pixel has width and height 0."""
    return [_info_record(pixels, boxes) for pixels, boxes in zip(truth.pixels.tolist(), truth.boxes.tolist(), strict=True)]


def _info_record(pixels: list[int], boxes: list[list[int]]) -> dict[str, Any]:
    whole, valid, visible = (pixels[column] for column in (_ALL, _VALID, _VISIBLE))
    return {
        "bbox_obj": _extent(boxes[_WHOLE]) if visible else NO_BOX,
        "bbox_visib": _extent(boxes[_SEEN]) if visible else NO_BOX,
        "px_count_all": whole,
        "px_count_valid": valid,
        "px_count_visib": visible,
        "visib_fract": visible / whole if whole else 0.0,
    }


def _extent(box: list[int]) -> list[int]:
    x_min, y_min, x_max, y_max = box
    return [x_min, y_min, x_max - x_min, y_max - y_min]


def coco_records(truth: ViewTruth, infos: list[dict[str, Any]], masks: list[Masks], height: int, width: int) -> Iterator[dict[str, Any]]:
    """Annotations of the instances that are visible, without ids: amodal box clipped to the image, visible mask."""
    for object_id, info, mask in zip(truth.object_id.tolist(), infos, masks, strict=True):
        box = mask.whole.box()
        area = mask.seen.count
        if box is not None and area:
            x_min, y_min, x_max, y_max = box
            yield {
                "image_id": truth.frame,
                "category_id": object_id,
                "iscrowd": 0,
                "area": area,
                "bbox": [x_min, y_min, x_max - x_min + 1, y_max - y_min + 1],
                "segmentation": run_length_record(mask.seen, height, width),
                "width": width,
                "height": height,
                "ignore": info["visib_fract"] < IGNORE_VISIBILITY,
            }


def run_length_record(runs: Runs, height: int, width: int) -> dict[str, Any]:
    """A mask as COCO's uncompressed run lengths, in which BOP has them as well."""
    return {"counts": runs.counts(height, width), "size": [height, width]}
