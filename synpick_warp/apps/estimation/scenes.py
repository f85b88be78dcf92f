"""Scenes of an estimation: which frames of an episode's camera are read, and their ground truth as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from msgspec import UNSET

from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.bop.arrays import SceneArrays, read_arrays
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view_files import SceneFiles
from synpick_warp.errors import DatasetError

_METERS = 1e-3
"""In a millimetre."""
_ORTHOGONAL = 1e-3
"""Tolerance of R Rᵀ = 1 for a rotation that is read, as in `dataset.view`."""
ABSENT = -1


@dataclass(frozen=True)
class ScenePlan:
    """Scene, episode and camera to read, and its frames in order."""

    scene: int
    """Index of the scene."""
    episode: int
    camera: int
    frames: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """Scene to estimate: F planned frames and S instances (slots, by instance index), with object-to-camera poses [m], visible fraction
    (NaN: not known), visible boxes, intrinsics [px], depth scale [m], and which instances are asked for.
    """

    plan: ScenePlan
    files: SceneFiles
    """Where its images are."""
    size: tuple[int, int]
    """Width and height of the images [px]."""
    instances: np.ndarray
    """Instance index by slot (S,) int64."""
    object_ids: np.ndarray
    """obj_id by slot (S,) int64."""
    index: np.ndarray
    """Index of the instance in the image's ground truth (F, S) int32; ABSENT: the image does not have it."""
    poses: np.ndarray
    """Object to camera (F, S, 4, 4) float64 [m]; the identity where absent."""
    visibility: np.ndarray
    """Visible fraction (F, S) float64; 0 where absent; NaN: it is not known."""
    boxes: np.ndarray
    """Visible box (F, S, 4) int64 [px]: x, y, width, height as BOP has them; -1: nothing is visible."""
    intrinsics: np.ndarray
    """fx, fy, cx, cy (F, 4) float32 [px]."""
    depth_scale: np.ndarray
    """Depth of one count (F,) float32 [m]."""
    asked: np.ndarray
    """Whether the instance is estimated in the frame (F, S) bool."""
    tracked: bool
    """Whether the instances can be followed from frame to frame: the annotations have instance ids."""

    def __len__(self) -> int:
        """Number of frames F."""
        return len(self.plan.frames)


def read_scene(data_set: DataSet, plan: ScenePlan) -> Scene:
    """Read the ground truth of a scene's planned frames; images are not read.

    Raises:
        DatasetError: A file is missing or damaged, or an instance has no index, two object ids, or is one of more than MAX_SLOTS.
    """
    # Records stay in memory as long as the object that has read them: images get another one.
    source = data_set.scene_files(plan.episode, plan.camera)
    place = source.place
    if source.lenient:
        _check_inputs(source)
    truth = read_arrays(source, plan.frames)
    truth.require_instances(place)
    instances, first, slot = np.unique(truth.instance, return_index=True, return_inverse=True)
    object_ids, frames = truth.object_id[first], truth.images[truth.row]
    other = np.flatnonzero(object_ids[slot] != truth.object_id)
    if len(other):
        instance, frame = truth.instance[other[0]], frames[other[0]]
        raise DatasetError(f"{place}: instance {instance} of image {frame} has another obj_id than before; {ADVICE}")
    counts = truth.counts
    shape = len(counts), len(instances)
    index, visibility = np.full(shape, ABSENT, np.int32), np.zeros(shape)
    poses, boxes = np.tile(np.eye(4), (*shape, 1, 1)), np.full((*shape, 4), -1, np.int64)
    cells = truth.row, slot
    twice = np.flatnonzero(np.bincount(np.ravel_multi_index(cells, shape), minlength=1) > 1)
    if len(twice):
        raise DatasetError(f"{place}: image {plan.frames[twice[0] // shape[1]]} has an instance_id twice; {ADVICE}")
    index[cells] = np.arange(len(truth)) - np.repeat(np.cumsum(counts) - counts, counts)
    visibility[cells], boxes[cells] = truth.visibility, truth.box
    poses[..., :3, :3][cells], poses[..., :3, 3][cells] = truth.rotation, _METERS * truth.translation
    _check_rotations(poses[..., :3, :3], plan, place)
    matrices, scales = _read_cameras(truth, place)
    return Scene(
        plan=plan,
        files=data_set.scene_files(plan.episode, plan.camera),
        size=source.image_size(plan.frames[0]),
        instances=instances,
        object_ids=object_ids,
        index=index,
        poses=poses,
        visibility=visibility,
        boxes=boxes,
        intrinsics=matrices[:, [0, 4, 2, 5]].astype(np.float32),
        depth_scale=(_METERS * scales).astype(np.float32),
        asked=index != ABSENT,
        tracked=truth.tracked,
    )


_INPUTS = {"gt": "ground truth (scene_gt.json)", "depth": "depth images", "mask_visib": "masks (mask_visib)"}


def _check_inputs(source: SceneFiles) -> None:
    """Check that a scene of a data set from another source has the inputs of pose estimation: keys of _INPUTS. Raises DatasetError."""
    for name, what in _INPUTS.items():
        if not source.has(name):
            raise DatasetError(f"{source.place} has no {what}, which poses are estimated with")


def _read_cameras(truth: SceneArrays, place: object) -> tuple[np.ndarray, np.ndarray]:
    """Camera matrices (F, 9) [px] and depth scales (F,) [mm]."""
    for image, camera in zip(truth.images, truth.cameras, strict=True):
        if missing := [key for key in ("cam_K", "depth_scale") if getattr(camera, key) is UNSET]:
            raise DatasetError(f"{place}: the camera of image {image} has no {missing[0]}, which poses are estimated with")
        if camera.cam_dist not in (UNSET, None):
            raise DatasetError(
                f"{place}: image {image} is distorted by its lens, and poses are estimated with pinhole cameras; undistort it"
            )
    matrices = np.reshape([camera.cam_K for camera in truth.cameras], (-1, 9))
    if not (matrices[:, [0, 4]] > 0.0).all():
        raise DatasetError(f"{place}: a focal length in cam_K is not above 0; {ADVICE}")
    return matrices, np.array([camera.depth_scale for camera in truth.cameras])


def _check_rotations(rotations: np.ndarray, plan: ScenePlan, place: object) -> None:
    """Check that matrices (F, S, 3, 3) are rotations."""
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(2, 3), initial=0.0)
    off = np.where(np.linalg.det(rotations) > 0.0, off, np.inf).max(axis=1, initial=0.0)
    if (off > _ORTHOGONAL).any():
        raise DatasetError(f"{place}: a cam_R_m2c of image {plan.frames[int(np.argmax(off > _ORTHOGONAL))]} is no rotation; {ADVICE}")
