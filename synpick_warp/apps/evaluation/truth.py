"""Pose tables: poses of many images as columns, and the ground truth of a data set as one, with visibility, episode, camera, mode and speed
of each instance in each image."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from msgspec import UNSET

from synpick_warp.dataset.bop.arrays import SceneArrays, read_arrays
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses of objects in camera coordinates, one row each, in SI units; rows are sorted by scene, image and object."""

    scene: np.ndarray
    """Scene index (N,) int64: an episode and camera."""
    image: np.ndarray
    """Image index in the scene (N,) int64: the frame."""
    object_id: np.ndarray
    """obj_id (N,) int64."""
    rotation: np.ndarray
    """Rotation object to camera (N, 3, 3) float64."""
    translation: np.ndarray
    """Translation object to camera (N, 3) float64 [m]."""
    score: np.ndarray
    """Confidence of an estimate (N,) float64; 1 for ground truth."""
    seconds: np.ndarray
    """Time that the method took for the image (N,) float64 [s]; -1: unknown."""
    instance: np.ndarray
    """Instance index in the episode (N,) int64: the same in all frames; -1: unknown, as in BOP result files."""

    def __len__(self) -> int:
        return len(self.scene)

    def select(self, rows: np.ndarray) -> "PoseTable":
        """Table of the rows that a mask or an index array selects."""
        return PoseTable(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """World-to-camera poses (M) of the images of cameras that move within their scene, sorted by scene and image.

    Motion, speed and tracks of objects are those in the world: for scenes of other cameras these are the same in camera coordinates.
    """

    scene: np.ndarray
    """Scene index (M,) int64."""
    image: np.ndarray
    """Image index (M,) int64."""
    rotation: np.ndarray
    """(M, 3, 3) float64."""
    translation: np.ndarray
    """(M, 3) float64 [m]."""

    def to_world(self, table: PoseTable) -> PoseTable:
        """Poses in the world in scenes of cameras that move; rows of other scenes as they are."""
        rows, at = self._find(table)
        back = self.rotation[at].transpose(0, 2, 1)
        return _with_poses(table, rows, back, np.einsum("nij,nj->ni", back, table.translation[rows] - self.translation[at]))

    def to_camera(self, table: PoseTable) -> PoseTable:
        """Poses in camera coordinates: the inverse of `to_world`."""
        rows, at = self._find(table)
        turn = self.rotation[at]
        return _with_poses(table, rows, turn, np.einsum("nij,nj->ni", turn, table.translation[rows]) + self.translation[at])

    def _find(self, table: PoseTable) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the table (n,) whose camera moves, and the index of each one's image (n,)."""
        place = {pair: index for index, pair in enumerate(zip(self.scene.tolist(), self.image.tolist(), strict=True))}
        at = np.array([place.get(pair, -1) for pair in zip(table.scene.tolist(), table.image.tolist(), strict=True)], np.int64)
        return np.flatnonzero(at >= 0), at[at >= 0]


def _with_poses(table: PoseTable, rows: np.ndarray, turn: np.ndarray, translation: np.ndarray) -> PoseTable:
    """Table with rotations turned and translations (n, 3) replaced in some rows (n,)."""
    rotations, translations = table.rotation.copy(), table.translation.copy()
    rotations[rows], translations[rows] = turn @ table.rotation[rows], translation
    return replace(table, rotation=rotations, translation=translations)


_METERS = 1e-3
"""In a millimetre."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground-truth poses (N rows), and the list of all images."""

    poses: PoseTable
    visibility: np.ndarray
    """Visible fraction of the silhouette (N,) float64; NaN: it is not known."""
    episode: np.ndarray
    """Index of the episode (N,) int64."""
    camera: np.ndarray
    """Index of the camera (N,) int64."""
    mode: np.ndarray
    """Mode of the episode (N,) str: pick, target, move or still."""
    speed: np.ndarray
    """Speed of the object's origin (N,) float64 [m/s], from the frame before, in an instance's first frame from the next one; NaN: the
    instance is in a single frame only."""
    images: np.ndarray
    """Scene and image index of all images (M, 2) int64, those without objects included, sorted."""
    motion: CameraMotion
    """Poses of the cameras that move."""

    def shown(self, minimum: float) -> np.ndarray:
        """Whether instances are at least so visible (N,) bool; also those of which it is not known."""
        return ~(self.visibility < minimum)

    def select(self, rows: np.ndarray) -> "Truth":
        """Ground truth of the rows that a mask selects; images stay."""
        columns = {name: getattr(self, name)[rows] for name in ("visibility", "episode", "camera", "mode", "speed")}
        return replace(self, poses=self.poses.select(rows), **columns)

    def __len__(self) -> int:
        return len(self.poses)


def read_truth(data_set: DataSet) -> Truth:
    """Read the ground truth of all committed episodes and cameras; raises DatasetError if the data set has no ground truth, instance ids or
    episode, a scene id in two splits, or a file missing or damaged."""
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
    frame `period` [s], speeds are NaN."""
    lengths = [len(arrays) for arrays, *_ in parts]

    def repeat(values: Iterable[int | str]) -> np.ndarray:
        return np.repeat(list(values), lengths)

    def stack(get: Callable[[SceneArrays], np.ndarray]) -> np.ndarray:
        return np.concatenate([get(arrays) for arrays, *_ in parts])

    images = np.concatenate([np.stack((np.full(len(part[0].images), part[1]), part[0].images), axis=1) for part in parts])
    scene = repeat(part[1] for part in parts).astype(np.int64)
    image, object_id = stack(lambda one: one.images[one.row]), stack(lambda one: one.object_id)
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
        motion=_read_motion([(arrays, scene) for arrays, scene, *_ in parts]),
    )
    speed = np.full(len(truth), np.nan) if period is None else instance_speeds(truth.motion.to_world(truth.poses), period)
    return replace(truth, speed=speed)


def _read_motion(scenes: list[tuple[SceneArrays, int]]) -> CameraMotion:
    """Poses of the cameras of those scenes whose images all have one, and not the same."""
    keys, poses = list[tuple[int, int]](), list[list[float]]()
    for arrays, scene in sorted(scenes, key=lambda pair: pair[1]):
        found = [(one.cam_R_w2c, one.cam_t_w2c) for one in arrays.cameras if UNSET not in (one.cam_R_w2c, one.cam_t_w2c)]
        if len(found) == len(arrays.images) and any(pose != found[0] for pose in found):
            keys += [(scene, image) for image in arrays.images.tolist()]
            poses += [[*rotation, *translation] for rotation, translation in found]
    numbers, places = np.reshape(np.array(poses, np.float64), (-1, 12)), np.reshape(np.array(keys, np.int64), (-1, 2))
    return CameraMotion(places[:, 0], places[:, 1], numbers[:, :9].reshape(-1, 3, 3), _METERS * numbers[:, 9:])


def instance_speeds(poses: PoseTable, period: float) -> np.ndarray:
    """Speed (N,) [m/s] of each instance's origin from the frame before, or else from the next one; NaN: neither frame has the instance.
    Poses are of cameras that stand still, or in the world; `period` is the time from frame to frame [s]."""
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
