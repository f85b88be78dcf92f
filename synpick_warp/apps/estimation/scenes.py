"""Scenes of an estimation: which frames of an episode's camera are read, and their ground truth as arrays.

Images are selected by mode, camera, episode, every n-th frame, or a BOP target list.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from msgspec import UNSET

from synpick_warp.apps.evaluation.results import TargetList
from synpick_warp.codes import Mode, names
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.bop.arrays import SceneArrays, read_arrays
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view_files import SceneFiles
from synpick_warp.errors import ConfigError, DatasetError, ResultError

_METERS = 1e-3
"""In a millimetre."""
_ORTHOGONAL = 1e-3
"""Tolerance of R Rᵀ = 1 for a rotation that is read, as in `dataset.view`."""
MAX_LISTED = 10
"""Maximum number of values that a message lists."""


@dataclass(frozen=True)
class ScenePlan:
    """Scene, episode and camera to read, and its frames in order."""

    scene: int
    episode: int
    camera: int
    frames: tuple[int, ...]


@dataclass(frozen=True)
class ImageSelection:
    """Filters of the images to estimate, by mode, camera and episode (None: all), frame or target list."""

    modes: tuple[str, ...] | None = None
    cameras: tuple[int, ...] | None = None
    episodes: tuple[int, ...] | None = None
    every: int = 1
    """Every n-th frame of a scene, from its first one."""
    targets: TargetList | None = field(default=None, repr=False)
    """Images and objects; instead of `every`."""


def plan_scenes(data_set: DataSet, selection: ImageSelection) -> tuple[list[ScenePlan], bool]:
    """Scenes of a data set with the frames of each for pose estimation, at least one, in order; and whether these are all images of the
    data set. Raises ConfigError if a mode, camera or episode does not exist, or nothing is left, DatasetError if there is no episode, and
    ResultError if an image of the target list does not exist."""
    known = list(data_set)
    if not known:
        raise DatasetError(f"{data_set.folder} has no episode to estimate poses in; finish the bake first")
    cameras = data_set.camera_count
    _check("--modes", selection.modes, names(Mode))
    _check("--cameras", selection.cameras, range(cameras))
    _check("--episodes", selection.episodes, known)
    listed: dict[int, list[int]] | None = None
    if selection.targets is not None:
        listed = {}
        for scene, image in sorted(selection.targets.objects):
            listed.setdefault(scene, []).append(image)
        scenes = {data_set.scene_id(episode, camera) for episode in known for camera in range(cameras)}
        if missing := sorted(listed.keys() - scenes):
            raise ResultError(f"{selection.targets.path}: the data set has no scene {missing[0]}")
    plans, total = [], 0
    for index in known:
        episode = data_set[index]
        total += sum(len(episode.images(camera)) for camera in episode.cameras)
        if selection.episodes is not None and index not in selection.episodes:
            continue
        if selection.modes is not None and episode.row.get("mode") not in selection.modes:
            continue
        for camera in episode.cameras if selection.cameras is None else sorted(set(selection.cameras) & set(episode.cameras)):
            scene, images = data_set.scene_id(index, camera), episode.images(camera)
            chosen = images[:: selection.every] if listed is None else listed.get(scene, [])
            if unknown := set(chosen) - set(images):
                path = selection.targets.path if selection.targets else data_set.folder
                raise ResultError(f"{path}: scene {scene} has no image {max(unknown)}; its images are {images[0]} to {images[-1]}")
            if chosen:
                plans.append(ScenePlan(scene, index, camera, tuple(chosen)))
    if not plans:
        raise ConfigError(f"no image of {data_set.folder} is left by --modes, --cameras, --episodes and --targets; drop one of them")
    return plans, sum(len(plan.frames) for plan in plans) == total


def _check(option: str, values: Sequence[object] | None, allowed: Sequence[object]) -> None:
    """Raise ConfigError for the first of an option's values (None: not given) that is not in `allowed`."""
    for value in values or ():
        if value not in allowed:
            shown = ", ".join(map(str, allowed[:MAX_LISTED])) + (", ..." if len(allowed) > MAX_LISTED else "")
            raise ConfigError(f"{option} names {value}; allowed: {shown}")


@dataclass(frozen=True, eq=False)
class EstimationScene:
    """Scene to estimate: F planned frames, and N instances in all of them together."""

    plan: ScenePlan
    files: SceneFiles
    """Where its images are."""
    truth: SceneArrays
    poses: np.ndarray
    """Object to camera (N, 4, 4) float64 [m]."""
    intrinsics: np.ndarray
    """fx, fy, cx, cy (F, 4) float32 [px]."""
    depth_scale: np.ndarray
    """Depth of one count (F,) float32 [m]."""
    asked: np.ndarray
    """Whether the instance is estimated (N,) bool."""

    def __len__(self) -> int:
        """Number of frames F."""
        return len(self.plan.frames)


def read_scene(data_set: DataSet, plan: ScenePlan) -> EstimationScene:
    """Read the ground truth of a scene's planned frames; images are not read. Raises DatasetError if a file is missing or damaged, or an
    instance has no index or two object ids."""
    # Records stay in memory as long as the object that has read them: images get another one.
    source = data_set.scene_files(plan.episode, plan.camera)
    place = source.place
    if not source.complete:
        _check_inputs(source)
    truth = read_arrays(source, plan.frames)
    truth.require_instances(place)
    instances, first, slot = np.unique(truth.instance, return_index=True, return_inverse=True)
    frames = truth.images[truth.row]
    other = np.flatnonzero(truth.object_id[first][slot] != truth.object_id)
    if len(other):
        instance, frame = truth.instance[other[0]], frames[other[0]]
        raise DatasetError(f"{place}: instance {instance} of image {frame} has another obj_id than before; {ADVICE}")
    twice = np.flatnonzero(np.bincount(truth.row * len(instances) + slot, minlength=1) > 1)
    if len(twice):
        raise DatasetError(f"{place}: image {plan.frames[twice[0] // len(instances)]} has an instance_id twice; {ADVICE}")
    wrong = np.flatnonzero(~_are_rotations(truth.rotation))
    if len(wrong):
        raise DatasetError(f"{place}: a cam_R_m2c of image {frames[wrong[0]]} is no rotation; {ADVICE}")
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = truth.rotation, _METERS * truth.translation
    matrices, scales = _read_cameras(truth, place)
    source.image_size(plan.frames[0])  # Refuses a scene without images.
    return EstimationScene(
        plan=plan,
        files=data_set.scene_files(plan.episode, plan.camera),
        truth=truth,
        poses=poses,
        intrinsics=matrices[:, [0, 4, 2, 5]].astype(np.float32),
        depth_scale=(_METERS * scales).astype(np.float32),
        asked=np.ones(len(truth), bool),
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


def _are_rotations(matrices: np.ndarray) -> np.ndarray:
    """Whether matrices (N, 3, 3) are rotations (N,) bool."""
    off = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return (off <= _ORTHOGONAL) & (np.linalg.det(matrices) > 0.0)
