"""Ground truth of a data set as a pose table, with visibility, episode, camera, mode and speed of each instance in each image."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.dataset.bop.arrays import SceneArrays, read_arrays
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError

_METERS = 1e-3
"""In a millimetre."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground-truth poses (N rows) with visibility, episode, camera, mode and speed of each row, and the list of all images, also those
    without objects.
    """

    poses: PoseTable
    visibility: np.ndarray
    """Visible fraction of the silhouette (N,) float64; NaN: it is not known."""
    episode: np.ndarray
    """Index of the episode (N,) int64."""
    camera: np.ndarray
    """Index of the camera (N,) int64."""
    mode: np.ndarray
    """Mode of the episode (N,) str: pick, target or move."""
    speed: np.ndarray
    """Speed of the object's origin (N,) float64 [m/s], from the frame before, in an instance's first frame from the next one; NaN: the
    instance is in a single frame only."""
    images: np.ndarray
    """Scene and image index of all images (M, 2) int64, those without objects included, sorted."""

    def shown(self, minimum: float) -> np.ndarray:
        """Whether instances are at least so visible (N,) bool; also those of which it is not known."""
        return ~(self.visibility < minimum)

    def __len__(self) -> int:
        return len(self.poses)


def read_truth(data_set: DataSet) -> Truth:
    """Read the ground truth of all committed episodes and cameras.

    Raises:
        DatasetError: The data set has no ground truth, instance ids or episode, a scene id in two splits, or a file missing or damaged.
    """
    parts, splits = [], dict[int, str]()
    for index, episode in data_set.items():
        mode = episode.row.get("mode")
        if not isinstance(mode, str):
            raise DatasetError(f"{data_set.folder}: the row of episode {index} has no mode; restore its manifest entry, or bake again")
        for camera in episode.cameras:
            scene, split = data_set.scene_id(index, camera), data_set.split_of(index)
            if splits.setdefault(scene, split) != split:
                raise DatasetError(f"{data_set.folder} has a scene {scene} in {splits[scene]} and in {split}; choose one by --split")
            files = data_set.scene_files(index, camera)
            if not files.has("gt"):
                raise DatasetError(f"{files.place} has no ground truth (scene_gt.json), which estimates are scored against")
            arrays = read_arrays(files, episode.images(camera))
            arrays.require_instances(files.place)
            parts.append((arrays, scene, index, camera, mode))
    if not parts:
        raise DatasetError(f"{data_set.folder} has no episode to evaluate on; finish the bake first")
    return _assemble(parts, data_set.period)


def _assemble(parts: list[tuple[SceneArrays, int, int, int, str]], period: float | None) -> Truth:
    """Build the table from `parts`: (arrays, scene_id, episode, camera, mode) of each scene, sorted by scene, image and object. Without a
    frame `period` [s], speeds are NaN.
    """
    lengths = [len(arrays) for arrays, *_ in parts]

    def repeat(values: Iterable[int | str]) -> np.ndarray:
        return np.repeat(list(values), lengths)

    def stack(get: Callable[[SceneArrays], np.ndarray]) -> np.ndarray:
        return np.concatenate([get(arrays) for arrays, *_ in parts])

    images = np.concatenate([np.stack((np.full(len(part[0].images), part[1]), part[0].images), axis=1) for part in parts])
    scene, image, object_id = (
        repeat(part[1] for part in parts).astype(np.int64),
        stack(lambda one: one.images[one.row]),
        stack(lambda one: one.object_id),
    )
    poses = PoseTable(
        scene=scene,
        image=image,
        object_id=object_id,
        rotation=stack(lambda one: one.rotation),
        translation=_METERS * stack(lambda one: one.translation),
        score=np.ones(len(scene)),
        seconds=np.full(len(scene), -1.0),
        instance=stack(lambda one: one.instance),
    )
    order = np.lexsort((object_id, image, scene))
    truth = Truth(
        poses=poses.select(order),
        visibility=stack(lambda one: one.visibility)[order],
        episode=repeat(part[2] for part in parts).astype(np.int64)[order],
        camera=repeat(part[3] for part in parts).astype(np.int64)[order],
        mode=repeat(part[4] for part in parts).astype(str)[order],
        speed=np.empty(0),
        images=images[np.lexsort(images.T[::-1])],
    )
    speed = np.full(len(truth), np.nan) if period is None else instance_speeds(truth.poses, period)
    return replace(truth, speed=speed)


def instance_speeds(poses: PoseTable, period: float) -> np.ndarray:
    """Speed of each instance's origin from consecutive frames of a camera that stands still.

    Args:
        poses: Poses with instances.
        period: Time from frame to frame [s].

    Returns:
        (N,) [m/s]: from the frame before, or else from the next one; NaN: neither frame has the instance.
    """
    order = np.lexsort((poses.image, poses.instance, poses.scene))
    scene, instance, image = (column[order] for column in (poses.scene, poses.instance, poses.image))
    consecutive = (np.diff(scene) == 0) & (np.diff(instance) == 0) & (np.diff(image) == 1)
    step = np.linalg.norm(np.diff(poses.translation[order], axis=0), axis=1) / period
    sorted_speed = np.full(len(order), np.nan)
    sorted_speed[:-1][consecutive] = step[consecutive]
    sorted_speed[1:][consecutive] = step[consecutive]
    speed = np.empty(len(order))
    speed[order] = sorted_speed
    return speed
