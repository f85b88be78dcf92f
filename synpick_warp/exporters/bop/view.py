"""One view in BOP format: its files and annotations (camera, poses, pixel counts, boxes, masks), encoded from what was rendered.

Runs in writer processes, so it imports neither Warp nor Newton. Only BOP's formats (bop, shards, coco) use millimetres.

Keypoints are points of the surface by farthest point sampling, with visibility from the depth image. PVNet (Peng et al., CVPR 2019) found
such points easier to locate than the corners of the bounding box. Here they have one more advantage: they lie on the surface, so the depth
image tells whether one is hidden; corners of boxes float in the air, and a centre is always inside.
"""

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson

from synpick_warp.codes import Effect, names
from synpick_warp.configs.calibration.lens import LensMap, read_lens
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.base import PIXEL_BYTES, EncodedView, StoredScene
from synpick_warp.exporters.writing import rle
from synpick_warp.exporters.writing.files import Buffer
from synpick_warp.exporters.writing.png import encode_png, frame_depth_png
from synpick_warp.scenes.types import Camera
from synpick_warp.system.codecs.jpeg import encode_jpeg
from synpick_warp.system.linear_algebra import matmul
from synpick_warp.views.frames import FrameBatch, bin_record, most_words, unpack_mask
from synpick_warp.views.layer_codec import encode_layer

MILLIMETERS = 1000.0
"""Millimetres per metre."""
UNLABELED, OCCLUDED, VISIBLE = 0, 1, 2
"""COCO's visibility flags: outside of the image (with x = y = 0), in it but hidden, in it and seen."""
TOLERANCE = 2.0
"""Distance by which a surface may lie in front of a keypoint that still counts as visible [mm], besides one pixel's width at its depth:
within a pixel, a surface inclined by 45° changes its depth by that width. Thinner than any object of YCB."""
_DECIMALS = 2
"""Decimal places of pixel coordinates."""
_POSITION_DECIMALS = 4
"""Decimal places of positions on the model [mm]."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one object, in the order in which they were sampled."""

    positions: np.ndarray
    """In the model's frame (K, 3) float64 [mm]."""
    edges: tuple[tuple[int, int], ...]
    """Skeleton edges, a tree: each keypoint is connected to its nearest predecessor in sampling order."""


def sample_keypoints(vertices: np.ndarray, count: int) -> Keypoints:
    """Farthest point sampling of vertices (V, 3) [m]: the first is farthest from the centre of the box, each next one from all before it.
    Objects with fewer than `count` different vertices have as many keypoints as these."""
    points = np.round(MILLIMETERS * vertices.astype(np.float64), _POSITION_DECIMALS)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    chosen = [int(np.argmax(np.linalg.norm(points - centre, axis=1)))]
    nearest = np.zeros(len(points), np.int64)
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    edges = []
    while len(chosen) < count and distance.max() > 0.0:
        point = int(np.argmax(distance))
        edges.append((int(nearest[point]), len(chosen)))
        apart = np.linalg.norm(points - points[point], axis=1)
        nearest[apart < distance] = len(chosen)
        distance = np.minimum(distance, apart)
        chosen.append(point)
    return Keypoints(points[chosen], tuple(edges))


def make_category_keys(keypoints: Keypoints) -> dict[str, Any]:
    """Keys of an object's COCO category: names, skeleton (from 1, as COCO counts), and positions in the model's frame [mm] as an extra."""
    return {
        "keypoints": [f"surface_{index}" for index in range(len(keypoints.positions))],
        "skeleton": [[a + 1, b + 1] for a, b in keypoints.edges],
        "keypoint_positions": keypoints.positions.tolist(),
    }


def project_keypoints(
    entries: list[dict[str, Any]], camera: dict[str, Any], depth: np.ndarray, keypoints: Mapping[int, Keypoints]
) -> list[dict[str, Any]]:
    """Keys of COCO annotations: `keypoints` as x, y, v for each, pixel centres at + 0.5, and `num_keypoints`, the number with v > 0.

    `entries` and `camera` are the view's in scene_gt.json and scene_camera.json, `keypoints` are by obj_id; depth (H, W) uint16 is in units
    of `depth_scale`, 0: no surface, which hides nothing.
    """
    matrix, lens = np.reshape(camera["cam_K"], (3, 3)), read_lens(camera, depth.shape[::-1])
    return [_project(entry, matrix, lens, depth, camera["depth_scale"], keypoints[entry["obj_id"]].positions) for entry in entries]


def _project(
    entry: dict[str, Any], matrix: np.ndarray, lens: LensMap | None, depth: np.ndarray, scale: float, positions: np.ndarray
) -> dict[str, Any]:
    """Project an instance's keypoints into the image: COCO's (x, y, visibility) for each; 0, 0, 0 outside of the image."""
    points = matmul(positions, np.reshape(entry["cam_R_m2c"], (3, 3)).T) + entry["cam_t_m2c"]
    z = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = matmul(points, matrix.T)
        pixels = pixels[:, :2] / pixels[:, 2:]
        if lens is not None:
            pixels = lens.project(points[:, :2] / np.where(z > 0.0, z, np.inf)[:, None])
    height, width = depth.shape
    inside = (z > 0.0) & (pixels >= 0.0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    columns, rows = np.where(inside[:, None], pixels, 0.0).astype(np.int64).T
    surface = scale * depth[rows, columns].astype(np.float64)
    hidden = (surface > 0.0) & (surface < z - TOLERANCE - z / matrix[0, 0])
    flags = np.where(inside, np.where(hidden, OCCLUDED, VISIBLE), UNLABELED)
    values: list[float] = []
    for (x, y), flag in zip(pixels.tolist(), flags.tolist(), strict=True):
        values += [round(x, _DECIMALS), round(y, _DECIMALS), flag] if flag else [0, 0, UNLABELED]
    return {"keypoints": values, "num_keypoints": int(inside.sum())}


ANNOTATIONS = "annotations"
"""Spool file of a staged scene: the annotation blocks of its views, in order of arrival; see `annotation_block`.

One file instead of one per view, because ext4 without a journal scans the inodes freed in the last minutes whenever it creates a file.
"""
NO_BOX = [-1, -1, -1, -1]
"""The toolkit's box of an instance without visible pixels (calc_gt_info.py)."""
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
    coco: bool
    camera: dict[str, Any]
    """Constant part of the views' entries in scene_camera.json."""
    resolution: tuple[int, int]
    """Width and height of the images [px]."""
    color: bool = True
    """Whether colour files are written."""
    depth: bool = True
    layers: tuple[str, ...] = ()
    keypoints: dict[int, Keypoints] = field(default_factory=dict)
    """Keypoints in COCO annotations, by obj_id; empty: none."""
    polygons: bool = False
    """Whether the format coco has polygons instead of run lengths."""
    graph: bool = False
    """Whether scene_graph.json is written."""
    classes: tuple[int, ...] = ()
    """obj_id of each class of the format yolo."""

    def __reduce__(self) -> tuple[Callable[[bytes], "ViewSettings"], tuple[bytes]]:
        """Interned pickle: one constant string, which a writer process decodes once; it comes with every view."""
        return _load_settings, (self._pickled,)

    @cached_property
    def _pickled(self) -> bytes:
        return pickle.dumps([getattr(self, each.name) for each in fields(self)])


@cache
def _load_settings(pickled: bytes) -> ViewSettings:
    """Decode pickled settings; equal strings give the same object."""
    return ViewSettings(*pickle.loads(pickled))


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Ground truth of a view: its row of `FrameBatch`, reduced to the N instances in the scene, and where its crops lie in the image."""

    scene: int
    """BOP scene_id."""
    frame: int
    """BOP im_id."""
    jpeg_quality: int
    extras: dict[str, Any]
    """Keys of this view's entry in scene_camera.json besides the camera's constant ones: light, camera effects, its own matrix and pose."""
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
    """Whether the source of visible masks is a list of run boundaries (True) or an image crop (False)."""
    top: int
    left: int
    run_count: np.ndarray
    """Run boundaries of each amodal mask of the view (I), if their source is a list; else empty, and it is the view's words."""
    mask_first: np.ndarray
    """First word of each amodal mask (N)."""
    mask_box: np.ndarray
    """Box of each amodal mask (N, 4) [px]."""


class RenderedView:
    """`EncodedView` of a rendered view, from the arrays (colour, depth, masks) and the ground truth that `make_view_task` collects."""

    graph = None

    def __init__(self, images: Sequence[np.ndarray], settings: ViewSettings, truth: ViewTruth) -> None:
        self._color, self._depth, self._visible, self._amodal = images
        self._settings, self._truth = settings, truth
        self.scene, self.frame = truth.scene, truth.frame
        self.camera = settings.camera | truth.extras
        self.gt, self.gt_info = make_gt_entries(truth, self.camera), make_gt_info_entries(truth)

    @property
    def color(self) -> tuple[str, Buffer]:
        """Suffix and encoded colour image; a file that the device has encoded (bytes,) uint8 stays as it is."""
        color, suffix = self._color, self._settings.color_suffix
        if color.ndim == 1:
            return suffix, color.data
        return suffix, encode_png(color) if suffix == ".png" else encode_jpeg(color, self._truth.jpeg_quality)

    @property
    def depth(self) -> bytes:
        """PNG file of the depth image; the compressed data (bytes,) uint8 that the device has made get their frame."""
        depth = self._depth
        return encode_png(depth) if depth.ndim > 1 else frame_depth_png(depth.data, *self._settings.resolution)

    def depth_image(self) -> np.ndarray:
        if self._depth.ndim > 1:
            return self._depth
        image = cv2.imdecode(np.frombuffer(self.depth, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError("OpenCV cannot decode a depth image; this is an error of synpick-warp, please report it")
        return image

    def masks(self) -> list[rle.Masks]:
        return extract_masks(self._visible, self._amodal, self._truth, self._settings.resolution[1])


WriteView = Callable[[EncodedView, Path, ViewSettings], None]
"""Writes a view to the staging folder of its scene: a format's `write_view`."""
WriteLayer = Callable[[Buffer, Path, int, str, int], None]
"""Writes a layer, a PNG file, to the staging folder of a scene: a format's `write_layer` (file, folder, scene_id, name, frame)."""


def write_rendered_view(
    color: np.ndarray,
    depth: np.ndarray,
    visible_source: np.ndarray,
    amodal_source: np.ndarray,
    write: WriteView,
    scene: Path,
    settings: ViewSettings,
    truth: ViewTruth,
) -> None:
    """Task: encode and write a rendered view."""
    write(RenderedView((color, depth, visible_source, amodal_source), settings, truth), scene, settings)


def write_rendered_layer(values: np.ndarray, write: WriteLayer, scene: Path, scene_id: int, name: str, frame: int) -> None:
    """Task: encode and write a layer of a rendered view."""
    write(encode_png(encode_layer(name, values)), scene, scene_id, name, frame)


def write_stored_views(
    stored: StoredScene, write: WriteView, write_layer: WriteLayer, layers: tuple[str, ...], scene: Path, settings: ViewSettings
) -> None:
    """Task: write all views of a stored scene with these layers."""
    for view in stored.views(range(stored.frames)):
        write(view, scene, settings)
        for name in layers:
            write_layer(view.layer(name), scene, view.scene, name, view.frame)


def make_camera_constants(camera: Camera, depth_scale: float) -> dict[str, Any]:
    """Constant part of a camera's entries in scene_camera.json."""
    return _pose_keys(camera.matrix, camera.rotation, camera.translation) | {"depth_scale": depth_scale, **camera.sensor}


def _pose_keys(matrix: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> dict[str, Any]:
    """Keys of scene_camera.json for a camera matrix and a pose, world to camera [m]."""
    return {
        "cam_K": matrix.ravel().tolist(),
        "cam_R_w2c": rotation.ravel().tolist(),
        "cam_t_w2c": (MILLIMETERS * translation).tolist(),
    }


def make_view_task(batch: FrameBatch, view: int, scene: int, settings: ViewSettings) -> tuple[tuple[np.ndarray, ...], ViewTruth]:
    """Collect the inputs of the task that writes a view. Returns colour (image or file), depth (image, data of its file, or nothing if none
    needs it), and two mask sources, of visible and of amodal masks: the device's run boundaries of `instance` and of the masks, or, if a
    list is incomplete or larger, the image cropped to the objects, and the words of the masks. And the ground truth."""
    present = np.flatnonzero(batch.object_id[view] >= 0)
    boxes = batch.boxes[view][present]
    width, height = settings.resolution
    boundaries, runs = _select_boundaries(batch, view, width * height), _select_runs(batch, view, most_words(width, height))
    rows, columns = (slice(0, 0), slice(0, 0)) if boundaries is not None else _crop_to_boxes(boxes, height, width)
    depth = batch.depth_source(view) if settings.depth or settings.keypoints else np.empty(0, np.uint8)
    parameters: dict[str, float] = dict(zip(names(Effect), batch.effects[view].tolist(), strict=True)) if settings.effects else {}
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
        listed=boundaries is not None,
        top=rows.start,
        left=columns.start,
        run_count=np.empty(0, np.int32) if runs is None or batch.run_count is None else batch.run_count[view].copy(),
        mask_first=batch.mask_first[view][present],
        mask_box=batch.mask_box[view][present],
    )
    visible = batch.instance[view][rows, columns] if boundaries is None else boundaries
    amodal = batch.mask_words[view, : batch.mask_length[view]] if runs is None else runs
    color = batch.color_source(view) if settings.color else np.empty(0, np.uint8)
    return (color, depth, visible, amodal), truth


def _make_extras(batch: FrameBatch, view: int, effects: dict[str, float]) -> dict[str, Any]:
    """Extra keys of a view's entry in scene_camera.json: light, and bin, matrix and pose, and camera effects where they differ."""
    direction = batch.light_direction[view]
    light = {
        "map": str(batch.light_name[view]),
        "yaw": round(float(batch.light_yaw[view]), _DIGITS),
        "exposure": round(float(batch.light_exposure[view]), _DIGITS),
        "direction": [round(part, _DIGITS) for part in direction.tolist()] if direction.any() else None,
    }
    own = {} if batch.bin_name is None or batch.bin_pose is None else {"bin": bin_record(str(batch.bin_name[view]), batch.bin_pose[view])}
    if batch.matrix is not None and batch.rotation is not None and batch.translation is not None:
        own |= _pose_keys(batch.matrix[view], batch.rotation[view], batch.translation[view])
    return {"light": light} | own | ({"effects": {name: round(value, _DIGITS) for name, value in effects.items()}} if effects else {})


def _select_boundaries(batch: FrameBatch, view: int, pixels: int) -> np.ndarray | None:
    """Run boundaries of `instance`; None unless they are present, complete, and no larger than an image of `pixels` pixels."""
    if batch.boundaries is None or batch.boundary_count is None or batch.boundary_count[view] > batch.boundaries.shape[-1]:
        return None
    listed = batch.boundaries[view, :, : batch.boundary_count[view]]
    return listed if listed.nbytes <= pixels * PIXEL_BYTES[-1] else None


def _select_runs(batch: FrameBatch, view: int, words: int) -> np.ndarray | None:
    """Run boundaries of the amodal masks; None unless they are present, complete, and no more than masks of `words` words each have."""
    if batch.runs is None or batch.run_count is None:
        return None
    counts = batch.run_count[view]
    return batch.runs[view, : counts.sum()] if counts.sum() <= min(batch.runs.shape[-1], counts.size * words) else None


def _crop_to_boxes(boxes: np.ndarray, height: int, width: int) -> tuple[slice, slice]:
    """Smallest crop (rows, columns) of the image that contains the in-image part of all boxes (N, 2, 4)."""
    amodal = boxes[:, _AMODAL_BOX][boxes[:, _AMODAL_BOX, 2] >= boxes[:, _AMODAL_BOX, 0]]
    left, top = (min(max(int(amodal[:, side].min(initial=size)), 0), size) for side, size in ((0, width), (1, height)))
    right, bottom = (min(1 + int(amodal[:, side].max(initial=-1)), size) for side, size in ((2, width), (3, height)))
    return slice(top, max(top, bottom)), slice(left, max(left, right))


def extract_masks(visible_source: np.ndarray, amodal_source: np.ndarray, truth: ViewTruth, height: int) -> list[rle.Masks]:
    """Extract the masks of all instances, in their order, from the two mask sources of `make_view_task`."""
    instances = truth.instance_id.tolist()
    ids = (
        rle.unpack_run_boundaries(visible_source, height)
        if truth.listed
        else rle.find_run_boundaries(visible_source, truth.top, truth.left)
    )
    if truth.run_count.size:
        amodal = rle.split_listed_runs(amodal_source, truth.run_count, height, instances)
    else:
        parts = zip(truth.mask_first.tolist(), truth.mask_box, strict=True)
        amodal = [rle.find_runs(unpack_mask(amodal_source, first, box), box[1], box[0]) for first, box in parts]
    return [rle.Masks(*pair) for pair in zip(amodal, ids.split_by_value(instances), strict=True)]


def annotation_block(frame: int, entries: Iterable[bytes]) -> bytes:
    """Format a view's block of `ANNOTATIONS`: a header line with the frame and the length of each entry [B], then one entry per line."""
    lines = tuple(entries)
    return b"\n".join((b" ".join(b"%d" % number for number in (frame, *map(len, lines))), *lines, b""))


def to_json(content: object) -> bytes:
    """Serialise to one line of JSON; arrays become lists."""
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def make_gt_entries(truth: ViewTruth, camera: dict[str, Any]) -> list[dict[str, Any]]:
    """The view's entry in scene_gt.json: model-to-camera poses [mm], computed in float64 from the world poses."""
    rotation = np.reshape(camera["cam_R_w2c"], (3, 3))
    translation = np.asarray(camera["cam_t_w2c"])
    pose = truth.pose.astype(np.float64)
    model = matmul(rotation, rotation_matrices(pose[:, 3:])).reshape(-1, 9)
    position = matmul(MILLIMETERS * pose[:, :3], rotation.T) + translation
    rows = zip(*(array.tolist() for array in (model, position, truth.object_id, truth.instance_id)), strict=True)
    return [dict(zip(("cam_R_m2c", "cam_t_m2c", "obj_id", "instance_id"), row, strict=True)) for row in rows]


def rotation_matrices(quaternion: np.ndarray) -> np.ndarray:
    """Convert quaternions x, y, z, w (N, 4) float64, of any length but zero, to rotation matrices (N, 3, 3)."""
    unit = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    (xx, xy, xz, xw), (_, yy, yz, yw), (_, _, zz, zw) = unit[:3, None] * unit
    matrix = 2 * np.stack((yy + zz, xy - zw, xz + yw, xy + zw, xx + zz, yz - xw, xz - yw, yz + xw, xx + yy), axis=-1)
    matrix[:, ::4] = 1 - matrix[:, ::4]
    return matrix.reshape(-1, 3, 3)


def make_gt_info_entries(truth: ViewTruth) -> list[dict[str, Any]]:
    """The view's entry in scene_gt_info.json. Boxes may exceed the image; a box of one pixel has width and height 0; invisible instances
    have no boxes (`NO_BOX`)."""
    return [
        {
            "bbox_obj": _bop_box(boxes[_AMODAL_BOX]) if visible else NO_BOX,
            "bbox_visib": _bop_box(boxes[_VISIBLE_BOX]) if visible else NO_BOX,
            "px_count_all": total,
            "px_count_valid": valid,
            "px_count_visib": visible,
            "visib_fract": visible / total if total else 0.0,
        }
        for (total, valid, visible), boxes in zip(truth.pixels.tolist(), truth.boxes.tolist(), strict=True)
    ]


def _bop_box(box: list[int]) -> list[int]:
    """x, y, width, height by BOP's convention: width = x_max - x_min, without + 1."""
    x_min, y_min, x_max, y_max = box
    return [x_min, y_min, x_max - x_min, y_max - y_min]


def make_keypoints(view: EncodedView, keypoints: Mapping[int, Keypoints]) -> list[dict[str, Any]]:
    """Keys of keypoints in the COCO annotations of a view's instances, by `project_keypoints`; none without keypoints. Raises DatasetError
    if a stored view has an object that the bake had not."""
    if not keypoints:
        return [{} for _ in view.gt]
    if unknown := {row["obj_id"] for row in view.gt} - keypoints.keys():
        raise DatasetError(f"image {view.frame} of scene {view.scene} has obj_id {min(unknown)}, which is none of the bake's objects")
    return project_keypoints(view.gt, view.camera, view.depth_image(), keypoints)


def make_rle(runs: rle.Runs, height: int, width: int) -> orjson.Fragment:
    """Mask in COCO's uncompressed run-length encoding, which BOP uses as well, for `to_json`."""
    return orjson.Fragment(_format_rle(runs, height, width))


@rle.cached_by_runs
def _format_rle(runs: rle.Runs, height: int, width: int) -> bytes:
    """JSON of a mask's run lengths."""
    return to_json({"counts": runs.counts(height, width), "size": [height, width]})
