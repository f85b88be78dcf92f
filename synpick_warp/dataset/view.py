"""Rendered views of a data set: images, masks, poses and camera of one frame, loaded when they are first used; and tracks of instances.

Transforms are 4x4 matrices named `A_to_B`: they map points of frame A to frame B [m]. Frames: `object`, the model's axes; `camera`,
OpenCV's axes (x right, y down, z forward); `world`, the tote's axes (z up). The centre of pixel (row, column) is (column + 0.5, row + 0.5).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import UNSET

from synpick_warp.configs.schema import LAYERS
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.view_files import SceneFiles, ViewRecords
from synpick_warp.errors import ConfigError, DatasetError, format_value, suggest
from synpick_warp.system.linear_algebra import is_rotation
from synpick_warp.views.layer_codec import decode_layer, image_format

if TYPE_CHECKING:
    from synpick_warp.configs.calibration.lens import LensMap
    from synpick_warp.dataset.reading import Episode

MILLIMETERS = 1000.0
"""In a metre: BOP's files are in millimetres, this module is in metres."""
PIXEL_CENTERS = {"synpick": 0.5, "opencv": 0.0, "open3d": 0.0}
"""Image coordinates of the centre of the first pixel [px], by convention."""


_FRAMES = ("camera", "world")
"""Frames of a point cloud."""


class CameraMatrix(np.ndarray):
    """Camera matrix K (3, 3) [px]; called with a convention, the matrix in that convention.

    OpenCV and Open3D count pixel centres at integers, this package at + 0.5: for them subtract 0.5 from cx and cy, as K("opencv") does.
    """

    def __call__(self, convention: str = "synpick") -> np.ndarray:
        """Matrix in the convention "synpick", "opencv" or "open3d". Raises ValueError if there is no such convention."""
        if convention not in PIXEL_CENTERS:
            raise ValueError(f"there is no convention {format_value(convention)}; conventions: {', '.join(PIXEL_CENTERS)}")
        matrix = np.array(self)
        matrix[:2, 2] += PIXEL_CENTERS[convention] - PIXEL_CENTERS["synpick"]
        return matrix

    def __array_wrap__(self, array: np.ndarray, context: Any = None, return_scalar: bool = False) -> Any:
        """Result of arithmetic, which is a plain array."""
        return array[()] if return_scalar else np.asarray(array)


class View:
    """One camera image with its ground truth. Arrays with N rows have one per instance, in BOP's order of ground-truth indices."""

    def __init__(
        self, files: SceneFiles, episode: int, camera: int, frame: int, image_id: int | None = None, owner: Episode | None = None
    ) -> None:
        """View of the scene's files: `image_id` is BOP's im_id, None: the frame's index; `owner` the episode, for its picks."""
        self._files, self._owner = files, owner
        self.episode, self.camera, self.frame = episode, camera, frame
        self.image_id = frame if image_id is None else image_id

    @property
    def place(self) -> str:
        """Folder or shard of the view, for messages."""
        return str(self._files.place)

    def has(self, name: str) -> bool:
        """Whether its scene has images or annotations of a type: rgb, depth, mask, mask_visib, gt, gt_info; those of a bake have all."""
        return self._files.has(name)

    @cached_property
    def records(self) -> ViewRecords:
        """Annotations as the files have them: BOP's keys, millimetres; `records.camera` has light and camera effects, too."""
        return self._files.records(self.image_id)

    @cached_property
    def rgb(self) -> np.ndarray:
        """Colour image, sRGB (H, W, 3) uint8, red first."""
        return np.ascontiguousarray(self._files.typed_image("rgb", self.image_id, 3, "uint8")[..., ::-1])

    @cached_property
    def depth(self) -> np.ndarray:
        """Planar depth (z in the camera frame) (H, W) float32 [m]; 0: no surface."""
        scale = np.float32(self._camera_value("depth_scale") / MILLIMETERS)
        return self._files.typed_image("depth", self.image_id, None, "uint16") * scale

    def _camera_value(self, key: str) -> Any:
        """Value of the view's entry in scene_camera.json; raises DatasetError if it is missing, as in some data sets of other programs."""
        if key not in self.records.camera:
            raise DatasetError(f"{self._files.place}: the camera of image {self.image_id} has no {key}")
        return self.records.camera[key]

    @cached_property
    def masks(self) -> np.ndarray:
        """Modal (visible) mask of each instance (N, H, W) bool; they never overlap."""
        return self._masks("mask_visib")

    @cached_property
    def amodal_masks(self) -> np.ndarray:
        """Amodal mask of each instance, visible or hidden (N, H, W) bool."""
        return self._masks("mask")

    def _masks(self, name: str) -> np.ndarray:
        """Masks (N, H, W) bool of one kind."""
        masks = self._files.masks(name, self.image_id, len(self))
        return np.stack(masks) if masks else np.zeros((0, *self._files.image_size(self.image_id)[::-1]), bool)

    @cached_property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers (AOVs, annotators) that the data set has, in the order of `LAYERS`."""
        present = self._files.layers()
        return tuple(name for name in LAYERS if name in present)

    def layer(self, name: str) -> np.ndarray:
        """Decode a layer, as `views.layer_codec.decode_layer`. Raises DatasetError if the data set has no such layer."""
        return read_layer(self._files, name, self.image_id)

    @cached_property
    def intrinsics(self) -> CameraMatrix:
        """Camera matrix K (3, 3) float64 [px]; `intrinsics("opencv")` is the one for OpenCV and Open3D."""
        matrix = np.reshape(np.asarray(self._camera_value("cam_K"), np.float64), (3, 3)).view(CameraMatrix)
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise DatasetError(f"{self._files.place}: the camera of image {self.image_id} has no focal length above 0; {ADVICE}")
        return matrix

    @cached_property
    def lens(self) -> LensMap | None:
        """Projection through the camera's lens, with `project`, `unproject` and `undistortion_maps`, which are for `cv2.remap`; None: a
        pinhole. Its `lens` has model and coefficients for OpenCV. Raises DatasetError if its values are none of a lens."""
        from synpick_warp.configs.calibration.lens import read_lens

        try:
            return read_lens(self.records.camera, self._files.image_size(self.image_id))
        except ConfigError as error:
            raise DatasetError(f"{self._files.place}: the camera of image {self.image_id} has a {error}; {ADVICE}") from None

    @cached_property
    def world_to_camera(self) -> np.ndarray:
        """World-to-camera transform (4, 4) float64 [m], OpenCV's axes."""
        camera, place = self.records.camera, f"{self._files.place}: the camera of image {self.image_id}"
        if not {"cam_R_w2c", "cam_t_w2c"} <= camera.keys():
            raise DatasetError(f"{place} has no cam_R_w2c and cam_t_w2c; {ADVICE}")
        transform = make_transform(camera["cam_R_w2c"], camera["cam_t_w2c"])
        if not is_rotation(transform[:3, :3]):
            raise DatasetError(f"{place} has a cam_R_w2c that is no rotation; {ADVICE}")
        return transform

    @cached_property
    def object_to_camera(self) -> np.ndarray:
        """Pose of each instance in the camera frame (N, 4, 4) float64 [m]."""
        return np.reshape([make_transform(row["cam_R_m2c"], row["cam_t_m2c"]) for row in self.records.gt], (-1, 4, 4))

    @cached_property
    def object_to_world(self) -> np.ndarray:
        """Pose of each instance in the world frame (N, 4, 4) float64 [m]."""
        return np.linalg.inv(self.world_to_camera) @ self.object_to_camera

    @cached_property
    def object_ids(self) -> np.ndarray:
        """BOP object id (class) of each instance (N) int64."""
        return self._column("gt", "obj_id", np.int64)

    @cached_property
    def instance_ids(self) -> np.ndarray:
        """Track id of each instance (N) int64: the same object in its whole episode and in all cameras; see `SceneFiles.instance_ids`."""
        ids = self._files.instance_ids([(row["obj_id"], row.get("instance_id", UNSET)) for row in self.records.gt])
        if ids is None:
            raise DatasetError(f"{self._files.place}: an instance of image {self.image_id} has no instance_id; {ADVICE}")
        return np.array(ids, np.int64)

    @cached_property
    def visibility(self) -> np.ndarray:
        """Visible fraction of each instance's silhouette (N) float64, from 0 to 1."""
        return self._column("gt_info", "visib_fract", np.float64)

    @cached_property
    def boxes(self) -> np.ndarray:
        """Amodal bounding boxes (N, 4) int64 [px]: x, y, width, height, as BOP has them; -1 if nothing is visible."""
        return self._column("gt_info", "bbox_obj", np.int64).reshape(-1, 4)

    @cached_property
    def visible_boxes(self) -> np.ndarray:
        """Bounding boxes of the visible parts (N, 4) int64 [px]; as `boxes`."""
        return self._column("gt_info", "bbox_visib", np.int64).reshape(-1, 4)

    @cached_property
    def support(self) -> np.ndarray:
        """Weighted support graph (N, N + 1) float64 [N]: upward force on the row's instance by the column's, mean over a frame;
        in the last column that of bin, table and objects without label. 0: it does not carry the instance."""
        edges = self._graph("support")
        support = np.zeros((len(self), len(self) + 1))
        for one, other, force in edges:
            support[one, other] = force
        return support

    @cached_property
    def occlusion(self) -> np.ndarray:
        """Occlusion graph, weighted (N, N) int64 [px]: pixels at which the instance of the row hides that of the column."""
        occlusion = np.zeros((len(self), len(self)), np.int64)
        for one, other, pixels in self._graph("occlusion"):
            occlusion[one, other] = pixels
        return occlusion

    @cached_property
    def order(self) -> tuple[tuple[int, ...], ...]:
        """Unstacking order: rows of the instances in an order in which none carries a later one; several at once carry each other."""
        return tuple(map(tuple, self._graph("order")))

    def _graph(self, key: str) -> list[Any]:
        """Part of the view's entry in scene_graph.json; raises DatasetError if there is none, or it names instances that do not exist."""
        entry = self._files.graph(self.image_id)
        if entry is None or key not in entry:
            raise DatasetError(f"{self._files.place} has no {key} graph of image {self.image_id}; bake bop with bop.graph = true")
        named = entry["order"] if key == "order" else [edge[:2] for edge in entry[key]]
        if any(index >= len(self) for indices in named for index in indices):
            raise DatasetError(
                f"{self._files.place}: the {key} graph of image {self.image_id} names an instance that is not there; {ADVICE}"
            )
        return entry[key]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self._files.image_size(self.image_id)

    @cached_property
    def picks(self) -> np.recarray:
        """Trials of grasps from the state of this frame, in the columns of `synpick_warp.views.picks.COLUMNS`; none if it is no state.
        Raises DatasetError if the data set has no picks."""
        if self._owner is None:
            raise DatasetError(f"{self._files.place} is read without its episode, which has the picks")
        trials = self._owner.picks
        return trials[trials["frame"] == self.frame].view(np.recarray)

    @cached_property
    def graspable(self) -> np.ndarray:
        """Simulated success at tried pixels (H, W) float32; NaN elsewhere. See `graspable_map`; errors as of `picks`."""
        picks = self.picks
        states = self._owner.pick_states if self._owner else ()
        return graspable_map(self, picks, hides=any(each.frame == self.frame and each.camera != self.camera for each in states))

    @property
    def suctions(self) -> np.ndarray:
        """Grasp candidates as suctionnetAPI has them (candidate, 7) float32; see `suction_group`, errors as of `picks`."""
        return suction_group(self, self.picks)

    def _column(self, record: str, key: str, dtype: type) -> np.ndarray:
        """Array of one key over the entries of `gt` or `gt_info`."""
        return np.array([row[key] for row in getattr(self.records, record)], dtype=dtype)

    def project(self, points: np.ndarray, transform: np.ndarray | None = None) -> np.ndarray:
        """Project points (..., 3) [m], in the camera frame or in one that `transform` (4, 4) maps to it, such as a row of
        `object_to_camera`, by the camera's matrix and, if it has one, its lens: x to the right and y down (..., 2) [px]; pixel (row,
        column) covers x from column to column + 1."""
        points = np.asarray(points, np.float64)
        if transform is not None:
            points = points @ transform[:3, :3].T + transform[:3, 3]
        if self.lens is not None:
            return self.lens.project(points[..., :2] / points[..., 2:])
        image = points @ self.intrinsics.T
        return image[..., :2] / image[..., 2:]

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Back-projection: points (..., 3) in the camera frame [m] at pixels (..., 2) as of `project`, with planar depth (...) [m]."""
        pixels = np.asarray(pixels, np.float64)
        if self.lens is not None:
            rays = self.lens.unproject(pixels)
        else:
            rays = np.insert(pixels, 2, 1.0, axis=-1) @ np.linalg.inv(self.intrinsics).T
            rays = rays[..., :2] / rays[..., 2:]
        return np.insert(rays, 2, 1.0, axis=-1) * np.asarray(depth, np.float64)[..., None]

    def points(self, frame: str = "camera", depth: np.ndarray | None = None) -> np.ndarray:
        """Organized point cloud: the point at each pixel's centre (H, W, 3) float32 [m], NaN where there is no surface. `frame`: frame of
        the points, "camera" or "world". `depth`: planar depth (H, W) [m], 0 without a surface, such as the layer of a simulated sensor;
        None: `depth`. Raises ValueError: there is no such frame."""
        if frame not in _FRAMES:
            raise ValueError(f"there is no frame {format_value(frame)}; frames: {', '.join(_FRAMES)}")
        from synpick_warp.configs.calibration.lens import pixel_rays

        depth = self.depth if depth is None else depth
        x, y = pixel_rays(self.intrinsics, self.lens, self.size)
        points = np.stack((x * depth, y * depth, depth), axis=-1)
        if frame == "world":
            transform = np.linalg.inv(self.world_to_camera)
            points = points @ transform[:3, :3].T + transform[:3, 3]
        return np.where(depth[..., None] > 0, points, np.nan).astype(np.float32)

    def __len__(self) -> int:
        """Number of instances N."""
        return len(self.records.gt)

    def __repr__(self) -> str:
        return f"View(episode {self.episode}, camera {self.camera}, frame {self.frame})"


def read_layer(files: SceneFiles, name: str, frame: int) -> np.ndarray:
    """Decode a layer of one image; values, units, shapes and errors as of `View.layer`."""
    if name not in LAYERS:
        raise DatasetError(f"there is no layer {name}{suggest(name, LAYERS)}; layers: {', '.join(LAYERS)}")
    dtype, channels = image_format(name)
    try:
        image = files.typed_image(name, frame, channels, dtype)
    except DatasetError:
        if files.has(name):
            raise
        present = [each for each in LAYERS if files.has(each)]
        raise DatasetError(f"{files.place} has no layer {name}; it has {', '.join(present) or 'none'}; bake with render.layers") from None
    return decode_layer(name, image if channels is None else image[..., ::-1])


def make_transform(rotation: Any, translation: Any) -> np.ndarray:
    """A rigid transform (4, 4) float64 [m] from BOP's rotation (9, row by row) and translation (3) [mm]."""
    transform = np.eye(4)
    transform[:3, :3] = np.reshape(np.asarray(rotation, np.float64), (3, 3))
    transform[:3, 3] = np.asarray(translation, np.float64) / MILLIMETERS
    return transform


def mean_by_candidate(picks: np.ndarray, name: str = "success") -> tuple[np.ndarray, np.ndarray]:
    """Group trials by candidate: the first trial of each, and the mean of a column over its repeats. Returns index of the first trial of
    each candidate (candidate) int64, and means (candidate) float64."""
    _, first, which = np.unique(picks[["state", "candidate"]], return_index=True, return_inverse=True)
    return first, np.bincount(which, picks[name], len(first)) / np.bincount(which, minlength=len(first))


def candidates(picks: np.ndarray) -> np.ndarray:
    """The first trial of each candidate, with the columns of a trial, in the order of `mean_by_candidate`."""
    return picks[mean_by_candidate(picks)[0]]


def find_pixels(view: View, picks: np.ndarray) -> np.ndarray:
    """Project grasp points to pixels of a view: column, row (trial, 2) int64; points may be hidden, or outside of the image."""
    return np.floor(view.project(picks["point"], view.world_to_camera)).astype(np.int64)


def graspable_map(view: View, picks: np.ndarray, hides: bool) -> np.ndarray:
    """Sparse success map (H, W) float32: share of the trials, from the view's frame, at a pixel that held an object; NaN: not tried.
    `hides`: whether to leave out (NaN) grasp points that the view does not show, for other cameras than the candidates'."""
    width, height = view.size
    result = np.full((height, width), np.nan, np.float32)
    if not len(picks):
        return result
    pixels = find_pixels(view, picks)
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    flat, which = np.unique(pixels[inside, 0] + width * pixels[inside, 1], return_inverse=True)
    means = np.bincount(which, picks["success"][inside], len(flat)) / np.bincount(which, minlength=len(flat))
    result.ravel()[flat] = means
    for instance in np.unique(picks["instance"]).tolist() if hides else ():
        own = np.unique(flat[which[picks["instance"][inside] == instance]])
        shown = view.masks[view.instance_ids == instance].any(axis=0).ravel()[own]
        result.ravel()[own[~shown]] = np.nan
    return result


def suction_group(view: View, picks: np.ndarray) -> np.ndarray:
    """Candidates as an array of suctionnetAPI (candidate, 7) float32: share of successful trials, direction (outward normal) and
    translation (grasp point) [m] in the camera frame."""
    first, success = mean_by_candidate(picks)
    rotation, offset = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    rows = (success, picks["normal"][first] @ rotation.T, picks["point"][first] @ rotation.T + offset)
    return np.column_stack(rows).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Track:
    """Poses, visibility and boxes of one instance over C cameras and the F frames of its episode; where it is not in the scene, poses are
    NaN, boxes -1, the rest 0. Poses: object to tote, object to camera [m]."""

    instance_id: int
    object_id: int
    """BOP object id (class)."""
    present: np.ndarray
    """Whether it is in the scene (F,) bool; visible or not."""
    object_to_world: np.ndarray
    """Poses in the tote's frame (F, 4, 4) float64 [m]; see `dataset.view` for frames and names."""
    object_to_camera: np.ndarray
    """Poses in the frame of each camera (C, F, 4, 4) float64 [m]."""
    visibility: np.ndarray
    """Visible fraction of the silhouette (C, F) float64."""
    visible_pixels: np.ndarray
    """(C, F) int64 [px]."""
    boxes: np.ndarray
    """Amodal bounding boxes (C, F, 4) int64 [px]: x, y, width, height, as BOP has them; -1 if nothing is visible."""
    visible_boxes: np.ndarray
    """Bounding boxes of the visible parts; as `boxes`."""

    def __len__(self) -> int:
        """Number of frames F of the episode."""
        return len(self.present)

    def __repr__(self) -> str:
        return f"Track(instance {self.instance_id}, object {self.object_id}, in {int(self.present.sum())} of {len(self)} frames)"


class Tracks(Mapping[int, Track]):
    """Tracks of an episode by instance id. All are made at once from the annotations of all its views, in any order, in one pass."""

    def __init__(self, views: Iterable[View], cameras: int, frames: int) -> None:
        self._size = cameras, frames
        self._tracks: dict[int, Track] = {}
        for view in views:
            self._add(view)

    def _add(self, view: View) -> None:
        place = view.camera, view.frame
        poses = view.object_to_camera
        worlds = view.object_to_world if view.camera == 0 else None
        counts = [row["px_count_visib"] for row in view.records.gt_info]
        for row, (instance, object_id) in enumerate(zip(view.instance_ids.tolist(), view.object_ids.tolist(), strict=True)):
            track = self._tracks.get(instance) or self._tracks.setdefault(instance, self._make(instance, object_id))
            track.object_to_camera[place] = poses[row]
            track.visibility[place] = view.visibility[row]
            track.visible_pixels[place] = counts[row]
            track.boxes[place] = view.boxes[row]
            track.visible_boxes[place] = view.visible_boxes[row]
            if worlds is not None:
                track.present[view.frame] = True
                track.object_to_world[view.frame] = worlds[row]

    def _make(self, instance: int, object_id: int) -> Track:
        """Empty track of an instance: absent in all frames, poses NaN, visibility and pixels 0."""
        cameras, frames = self._size
        return Track(
            instance_id=instance,
            object_id=object_id,
            present=np.zeros(frames, bool),
            object_to_world=np.full((frames, 4, 4), np.nan),
            object_to_camera=np.full((cameras, frames, 4, 4), np.nan),
            visibility=np.zeros((cameras, frames)),
            visible_pixels=np.zeros((cameras, frames), np.int64),
            boxes=np.full((cameras, frames, 4), -1, np.int64),
            visible_boxes=np.full((cameras, frames, 4), -1, np.int64),
        )

    def __getitem__(self, instance_id: int) -> Track:
        if instance_id not in self._tracks:
            raise KeyError(f"there is no instance {instance_id}; instances: {', '.join(map(str, self))}")
        return self._tracks[instance_id]

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self._tracks))

    def __len__(self) -> int:
        return len(self._tracks)

    def __repr__(self) -> str:
        return f"Tracks({', '.join(map(str, self))})"
