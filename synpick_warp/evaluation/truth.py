"""Ground truth of a data set as a pose table, with visibility, episode, camera, mode and speed of each instance in each image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.errors import DatasetError
from synpick_warp.evaluation.poses import PoseTable

_METERS = 1e-3
"""In a millimetre."""


@dataclass(frozen=True, eq=False)
class Truth:
    """True poses and what they are grouped by; arrays with N entries have one per row of `poses`."""

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
        DatasetError: The data set has no images or no episode, or a file is missing or damaged.
    """
    parts, images, splits = [], [], dict[int, str]()
    for index, episode in data_set.items():
        mode = episode.row.get("mode")
        if not isinstance(mode, str):
            raise DatasetError(f"{data_set.folder}: the row of episode {index} has no mode; restore its manifest entry, or bake again")
        for camera in episode.cameras:
            scene, split = data_set.scene_id(index, camera), data_set.split_of(index)
            if splits.setdefault(scene, split) != split:
                raise DatasetError(f"{data_set.folder} has a scene {scene} in {splits[scene]} and in {split}; choose one by --split")
            found, rows = _read_scene(episode, camera)
            images += [(scene, image) for image in found]
            parts.append((rows, scene, index, camera, mode))
    if not parts:
        raise DatasetError(f"{data_set.folder} has no episode to evaluate on; finish the bake first")
    return _assemble(parts, np.reshape(np.array(images, np.int64), (-1, 2)), data_set.period)


_Rows = list[tuple[int, int, int, list[float], list[float], float]]
"""(frame, obj_id, instance, rotation, translation, visibility) of a scene."""


def _read_scene(episode: Episode, camera: int) -> tuple[list[int], _Rows]:
    """Images of a scene, and its rows."""
    images, rows = [], []
    for view in episode.views(camera):
        records = view.records
        if not images and not view.has("gt"):
            raise DatasetError(f"{view.place} has no ground truth (scene_gt.json), which estimates are scored against")
        images.append(view.image_id)
        for instance, entry, info in zip(view.instance_ids.tolist(), records.gt, records.gt_info, strict=True):
            rows.append((view.image_id, entry["obj_id"], instance, entry["cam_R_m2c"], entry["cam_t_m2c"], info["visib_fract"]))
    return images, rows


def _assemble(parts: list[tuple[_Rows, int, int, int, str]], images: np.ndarray, period: float | None) -> Truth:
    """Columns from the rows of all scenes, sorted by scene, image and object."""
    lengths = [len(rows) for rows, *_ in parts]

    def repeat(column: int) -> np.ndarray:
        return np.repeat([part[column] for part in parts], lengths)

    def stack(column: int, dtype: type) -> np.ndarray:
        return np.array([row[column] for rows, *_ in parts for row in rows], dtype)

    scene, image, object_id = repeat(1).astype(np.int64), stack(0, np.int64), stack(1, np.int64)
    poses = PoseTable(
        scene=scene,
        image=image,
        object_id=object_id,
        rotation=stack(3, np.float64).reshape(-1, 3, 3),
        translation=_METERS * stack(4, np.float64).reshape(-1, 3),
        score=np.ones(len(scene)),
        seconds=np.full(len(scene), -1.0),
        instance=stack(2, np.int64),
    )
    order = np.lexsort((object_id, image, scene))
    truth = Truth(
        poses=poses.select(order),
        visibility=stack(5, np.float64)[order],
        episode=repeat(2).astype(np.int64)[order],
        camera=repeat(3).astype(np.int64)[order],
        mode=repeat(4).astype(str)[order],
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
