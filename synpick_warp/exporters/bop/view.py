"""One view in BOP format: image files, and annotations (camera, poses, pixel counts, boxes, COCO masks).

Runs in writer processes, so it imports neither Warp nor Newton. Only BOP's formats (bop, shards, coco) use millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson

from synpick_warp.codecs.jpeg import encode_jpeg
from synpick_warp.codes import Effect, names
from synpick_warp.exporters.base import PIXEL_BYTES
from synpick_warp.exporters.bop.keypoints import MILLIMETERS, Keypoints, project_keypoints
from synpick_warp.exporters.writing.folder import Buffer, open_folder
from synpick_warp.exporters.writing.png import encode_mask_png, encode_png, frame_depth_png
from synpick_warp.exporters.writing.rle import Runs, find_run_boundaries, unpack_run_boundaries
from synpick_warp.frames import FrameBatch
from synpick_warp.layer_codec import encode_layer, layer_path
from synpick_warp.scenes.types import Camera

ANNOTATIONS = "annotations"
"""Spool file of a staged scene: the annotation blocks of its views, in order of arrival; see `annotation_block`.

One file instead of one per view, because ext4 without a journal scans the inodes freed in the last minutes whenever it creates a file.
"""
IGNORE_VISIBILITY = 0.1
"""COCO annotations with a lower visible fraction are marked `ignore` (the toolkit's calc_gt_coco.py)."""
NO_BOX = [-1, -1, -1, -1]
"""The toolkit's box of an instance without visible pixels (calc_gt_info.py)."""
_ALL, _VALID, _VISIBLE = 0, 1, 2
"""Columns of `FrameBatch.pixels`."""
_AMODAL_BOX, _VISIBLE_BOX = 0, 1
"""Rows of `FrameBatch.boxes`."""
_DIGITS = 6
"""Decimal places of light and camera-effect parameters."""
JPEG_QUALITY = "jpeg_quality"
"""The camera effect (see `Effect`) that the writer applies."""


@dataclass(frozen=True)
class ViewSettings:
    """Settings common to all views of a camera."""

    color_suffix: str
    """.jpg or .png."""
    jpeg_quality: int
    """Default; a view has its own if `effects` names JPEG quality."""
    effects: tuple[str, ...]
    """Names of the active camera effects."""
    masks: bool
    """Whether mask files are written."""
    coco: bool
    """Whether COCO annotations are written."""
    camera: dict[str, Any]
    """Constant part of the views' entries in scene_camera.json."""
    resolution: tuple[int, int]
    """Width and height of the images [px]."""
    depth: bool = True
    """Whether depth files are written."""
    keypoints: dict[int, Keypoints] = field(default_factory=dict)
    """Keypoints in COCO annotations, by obj_id; empty: none."""


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Ground truth of a view: its row of `FrameBatch`, reduced to the `N` instances that are in the scene."""

    scene: int
    """BOP scene_id."""
    frame: int
    """BOP im_id."""
    jpeg_quality: int
    extras: dict[str, Any]
    """Keys of this view's entry in scene_camera.json besides the camera: light and camera effects."""
    instance_id: np.ndarray
    """(N)"""
    object_id: np.ndarray
    """(N)"""
    pose: np.ndarray
    """Object-to-world poses (N, 7) [m]."""
    pixels: np.ndarray
    """Pixel counts (N, 3)."""
    boxes: np.ndarray
    """Amodal and visible boxes (N, 2, 4) [px]."""
    listed: bool
    """Whether the mask sources of the view's task are lists of run boundaries (True) or image crops (False)."""
    top: int
    """First row of the crops."""
    left: int
    """First column of the crops."""


@dataclass(frozen=True, eq=False)
class Masks:
    """The two masks of an instance, both clipped to the image."""

    amodal: Runs
    """Silhouette, including hidden parts."""
    visible: Runs
    """Visible (modal) part."""


def make_camera_constants(camera: Camera, depth_scale: float) -> dict[str, Any]:
    """Constant part of a camera's entries in scene_camera.json."""
    return {
        "cam_K": camera.matrix.ravel().tolist(),
        "cam_R_w2c": camera.rotation.ravel().tolist(),
        "cam_t_w2c": (MILLIMETERS * camera.translation).tolist(),
        "depth_scale": depth_scale,
    }


def make_view_task(batch: FrameBatch, view: int, scene: int, settings: ViewSettings) -> tuple[tuple[np.ndarray, ...], ViewTruth]:
    """Collect the inputs of the task that writes a view.

    Returns:
        Colour (image or file), depth (image, data of its file, or nothing if neither files nor keypoints need it), and two mask sources,
        of visible and of amodal masks: the device's run boundaries of the images `instance` and `amodal`, or, if these lists are incomplete
        or larger, the images themselves, cropped to the objects. And the ground truth.
    """
    present = np.flatnonzero(batch.object_id[view] >= 0)
    boxes = batch.boxes[view][present]
    width, height = settings.resolution
    boundaries = _select_boundaries(batch, view, width * height)
    rows, columns = (slice(0, 0), slice(0, 0)) if boundaries else _crop_to_boxes(boxes, height, width)
    depth = batch.depth_source(view) if settings.depth or settings.keypoints else np.empty(0, np.uint8)
    parameters: dict[str, float] = dict(zip(names(Effect), batch.effects[view].tolist(), strict=True))
    truth = ViewTruth(
        scene=scene,
        frame=int(batch.frame[view]),
        jpeg_quality=round(parameters[JPEG_QUALITY]) if JPEG_QUALITY in settings.effects else settings.jpeg_quality,
        extras=_make_extras(batch, view, {name: parameters[name] for name in settings.effects}),
        instance_id=present,
        object_id=batch.object_id[view][present],
        pose=batch.pose[view][present],
        pixels=batch.pixels[view][present],
        boxes=boxes,
        listed=bool(boundaries),
        top=rows.start,
        left=columns.start,
    )
    sources = boundaries or tuple(images[view][rows, columns] for images in (batch.instance, batch.amodal))
    return (batch.color_source(view), depth, *sources), truth


def _make_extras(batch: FrameBatch, view: int, effects: dict[str, float]) -> dict[str, Any]:
    """Extra keys of a view's entry in scene_camera.json: light, and camera effects if any are active."""
    direction = batch.light_direction[view]
    light = {
        "map": str(batch.light_name[view]),
        "yaw": round(float(batch.light_yaw[view]), _DIGITS),
        "exposure": round(float(batch.light_exposure[view]), _DIGITS),
        "direction": [round(part, _DIGITS) for part in direction.tolist()] if direction.any() else None,
    }
    return {"light": light} | ({"effects": {name: round(value, _DIGITS) for name, value in effects.items()}} if effects else {})


def _select_boundaries(batch: FrameBatch, view: int, pixels: int) -> tuple[np.ndarray, ...]:
    """Run boundaries of `instance` and `amodal`; empty unless both are present, complete, and no larger than images of `pixels` pixels."""
    if batch.boundaries is None or batch.boundary_count is None or (batch.boundary_count[view] > batch.boundaries.shape[-1]).any():
        return ()
    counts = batch.boundary_count[view].tolist()
    lists = tuple(packed[:, :count] for packed, count in zip(batch.boundaries[view], counts, strict=True))
    sizes = [pixels * size for size in PIXEL_BYTES[-2:]]
    return lists if all(packed.nbytes <= size for packed, size in zip(lists, sizes, strict=True)) else ()


def _crop_to_boxes(boxes: np.ndarray, height: int, width: int) -> tuple[slice, slice]:
    """Smallest crop (rows, columns) of the image that contains the in-image part of all boxes (N, 2, 4)."""
    amodal = boxes[:, _AMODAL_BOX][boxes[:, _AMODAL_BOX, 2] >= boxes[:, _AMODAL_BOX, 0]]
    left, top = (min(max(int(amodal[:, side].min(initial=size)), 0), size) for side, size in ((0, width), (1, height)))
    right, bottom = (min(1 + int(amodal[:, side].max(initial=-1)), size) for side, size in ((2, width), (3, height)))
    return slice(top, max(top, bottom)), slice(left, max(left, right))


def extract_masks(visible_source: np.ndarray, amodal_source: np.ndarray, truth: ViewTruth, height: int) -> list[Masks]:
    """Extract the masks of all instances, in their order, from the two mask sources of `make_view_task`."""
    visible, amodal = (
        unpack_run_boundaries(source, height) if truth.listed else find_run_boundaries(source, truth.top, truth.left)
        for source in (visible_source, amodal_source)
    )
    instances = truth.instance_id.tolist()
    return [Masks(*pair) for pair in zip(amodal.split_by_bit(instances), visible.split_by_value(instances), strict=True)]


def write_view(
    color: np.ndarray,
    depth: np.ndarray,
    visible_source: np.ndarray,
    amodal_source: np.ndarray,
    scene: Path,
    settings: ViewSettings,
    truth: ViewTruth,
) -> None:
    """Task: write a view's images into the folders of a staged scene, and append its annotation block to `ANNOTATIONS`.

    The block holds the entries of scene_camera, scene_gt and scene_gt_info, then the COCO annotations, without their ids.
    """
    name = f"{truth.frame:06d}"
    width, height = settings.resolution
    with open_folder(scene) as folder:
        folder.write(f"rgb/{name}{settings.color_suffix}", encode_color(color, settings, truth.jpeg_quality))
        folder.write(f"depth/{name}.png", encode_depth(depth, settings))
        masks = extract_masks(visible_source, amodal_source, truth, height) if settings.masks or settings.coco else []
        if settings.masks:
            for index, mask in enumerate(masks):
                amodal, visible = encode_masks(mask, height, width)
                folder.write(f"mask/{name}_{index:06d}.png", amodal)
                folder.write(f"mask_visib/{name}_{index:06d}.png", visible)
        infos = make_gt_info_entries(truth)
        poses = make_gt_entries(truth, settings.camera)
        entries = [make_camera_entry(truth, settings), poses, infos]
        if settings.coco:
            keypoints = settings.keypoints
            points = project_keypoints(poses, settings.camera, read_depth(depth, settings), keypoints) if keypoints else None
            entries += make_coco_annotations(truth, infos, masks, height, width, points)
        folder.append(ANNOTATIONS, annotation_block(truth.frame, map(to_json, entries)))


def annotation_block(frame: int, entries: Iterable[bytes]) -> bytes:
    """Format a view's block of `ANNOTATIONS`: a header line with the frame and the length of each entry [B], then one entry per line."""
    lines = tuple(entries)
    return b"\n".join((b" ".join(b"%d" % number for number in (frame, *map(len, lines))), *lines, b""))


def write_layer(values: np.ndarray, scene: Path, name: str, frame: int) -> None:
    """Task: write a view's layer into the folder of that name."""
    layer_path(scene, name, frame).write_bytes(encode_png(encode_layer(name, values)))


def encode_color(color: np.ndarray, settings: ViewSettings, jpeg_quality: int) -> Buffer:
    """Encode an RGB image (H, W, 3) uint8 in the format that the settings name. A file (bytes) uint8 of the device stays as it is."""
    if color.ndim == 1:
        return color.data
    return encode_png(color) if settings.color_suffix == ".png" else encode_jpeg(color, jpeg_quality)


def encode_depth(depth: np.ndarray, settings: ViewSettings) -> bytes:
    """Encode a depth image (H, W) uint16 as PNG, or frame the data (bytes) uint8 of a file that the device has made."""
    return encode_png(depth) if depth.ndim > 1 else frame_depth_png(depth.data, *settings.resolution)


def read_depth(depth: np.ndarray, settings: ViewSettings) -> np.ndarray:
    """Depth image (H, W) uint16, decoded if `depth` is the data (bytes) uint8 of its file."""
    if depth.ndim > 1:
        return depth
    image = cv2.imdecode(np.frombuffer(encode_depth(depth, settings), np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("OpenCV cannot decode a depth image; this is an error of synpick-warp, please report it")
    return image


def encode_masks(masks: Masks, height: int, width: int) -> tuple[bytes, bytes]:
    """Encode an instance's amodal and visible mask as PNG. If nothing hides the instance they are equal, and are encoded once."""
    amodal = encode_mask_png(masks.amodal, height, width)
    return amodal, amodal if masks.amodal.count == masks.visible.count else encode_mask_png(masks.visible, height, width)


def to_json(content: object) -> bytes:
    """Serialise to one line of JSON; arrays become lists."""
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def make_camera_entry(truth: ViewTruth, settings: ViewSettings) -> dict[str, Any]:
    """The view's entry in scene_camera.json."""
    return settings.camera | truth.extras


def make_gt_entries(truth: ViewTruth, camera: dict[str, Any]) -> list[dict[str, Any]]:
    """The view's entry in scene_gt.json: model-to-camera poses [mm], computed in float64 from the world poses."""
    rotation = np.reshape(camera["cam_R_w2c"], (3, 3))
    translation = np.asarray(camera["cam_t_w2c"])
    pose = truth.pose.astype(np.float64)
    model = (rotation @ rotation_matrices(pose[:, 3:])).reshape(-1, 9)
    position = MILLIMETERS * pose[:, :3] @ rotation.T + translation
    rows = zip(*(array.tolist() for array in (model, position, truth.object_id, truth.instance_id)), strict=True)
    return [dict(zip(("cam_R_m2c", "cam_t_m2c", "obj_id", "instance_id"), row, strict=True)) for row in rows]


def rotation_matrices(quaternion: np.ndarray) -> np.ndarray:
    """Convert quaternions x, y, z, w (N, 4) float64, of any length but zero, to rotation matrices (N, 3, 3)."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def make_gt_info_entries(truth: ViewTruth) -> list[dict[str, Any]]:
    """The view's entry in scene_gt_info.json. Boxes may exceed the image; a box of one pixel has width and height 0."""
    return [_make_gt_info(pixels, boxes) for pixels, boxes in zip(truth.pixels.tolist(), truth.boxes.tolist(), strict=True)]


def _make_gt_info(pixels: list[int], boxes: list[list[int]]) -> dict[str, Any]:
    total, valid, visible = (pixels[column] for column in (_ALL, _VALID, _VISIBLE))
    return {
        "bbox_obj": _bop_box(boxes[_AMODAL_BOX]) if visible else NO_BOX,
        "bbox_visib": _bop_box(boxes[_VISIBLE_BOX]) if visible else NO_BOX,
        "px_count_all": total,
        "px_count_valid": valid,
        "px_count_visib": visible,
        "visib_fract": visible / total if total else 0.0,
    }


def _bop_box(box: list[int]) -> list[int]:
    """x, y, width, height by BOP's convention: width = x_max - x_min, without + 1."""
    x_min, y_min, x_max, y_max = box
    return [x_min, y_min, x_max - x_min, y_max - y_min]


def make_coco_annotations(
    truth: ViewTruth,
    infos: list[dict[str, Any]],
    masks: list[Masks],
    height: int,
    width: int,
    points: list[dict[str, Any]] | None = None,
) -> Iterator[dict[str, Any]]:
    """COCO annotations of the visible instances, without ids: amodal box clipped to the image, visible mask, keys of keypoints."""
    keys = points or [{} for _ in infos]
    for object_id, info, mask, extra in zip(truth.object_id.tolist(), infos, masks, keys, strict=True):
        box = mask.amodal.box()
        area = mask.visible.count
        if box is not None and area:
            x_min, y_min, x_max, y_max = box
            yield {
                "image_id": truth.frame,
                "category_id": object_id,
                "iscrowd": 0,
                "area": area,
                "bbox": [x_min, y_min, x_max - x_min + 1, y_max - y_min + 1],
                "segmentation": make_rle(mask.visible, height, width),
                "width": width,
                "height": height,
                "ignore": info["visib_fract"] < IGNORE_VISIBILITY,
            } | extra


def make_rle(runs: Runs, height: int, width: int) -> dict[str, Any]:
    """A mask as COCO's uncompressed RLE, which BOP uses as well."""
    return {"counts": runs.counts(height, width), "size": [height, width]}
