"""Evaluation protocols of pose estimation: initialization and input of each method, and the frames and instances it estimates.

`single`: nothing but the frame. `refine` and `gicp`: the truth, disturbed. `track`: the truth in an instance's first frame, afterwards its
own estimate, without restart (ICG's protocol). All are given the visible masks of the instances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.apps.estimation.disturbance import disturb_poses
from synpick_warp.apps.estimation.scenes import ABSENT, Scene
from synpick_warp.stages.pose.batch import Estimates, InstanceTable, RgbdBatch

SINGLE, REFINE, TRACK, GICP = "single", "refine", "track", "gicp"
METHODS = (SINGLE, REFINE, TRACK, GICP)
SPARSE = 20
"""Default of `--every` for methods that look at one frame at a time: consecutive frames differ little."""


class Estimator(Protocol):
    """Pose estimator of an `InstanceTable`: `estimate` serves single, `refine` refine and gicp, `start` and `track` track."""

    def estimate(self, batch: RgbdBatch) -> Estimates:
        """Estimate the pose of each instance from a single frame, without a start."""
        ...

    def refine(self, batch: RgbdBatch, pose: np.ndarray) -> Estimates:
        """Refine poses (N, 7) float32 as in `Estimates`; rows of instances without a label are the identity."""
        ...

    def start(self, pose: np.ndarray, rows: np.ndarray) -> None:
        """Set the poses (N, 7) float32 of the rows (N,) bool, in the frame of the next `track`; other tracks are unaffected."""
        ...

    def track(self, batch: RgbdBatch) -> Estimates:
        """Update all started tracks with the next frame; returns their poses."""
        ...


EstimatorFactory = Callable[[InstanceTable, int, int], Estimator]
"""Makes the estimator of a group of scenes: instances, height and width of the images [px]."""


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Ground truth of the N instances of a group in one step: which are asked for, which tracks start, and poses from object to
    camera [m].
    """

    asked: np.ndarray
    """Mask of the instances to estimate (N,) bool."""
    starting: np.ndarray
    """Mask of the instances whose tracks start (N,) bool."""
    poses: np.ndarray
    """Object to camera (N, 4, 4) float64 [m]; the identity where not asked."""


@dataclass(frozen=True, eq=False)
class Group:
    """Scenes that are estimated side by side, and the table of their instances."""

    scenes: tuple[Scene, ...]
    table: InstanceTable

    def truth(self, step: int) -> FrameTruth:
        """Ground truth of the group's instances in a step."""
        rows = len(self.table)
        asked, starting, poses = np.zeros(rows, bool), np.zeros(rows, bool), np.tile(np.eye(4), (rows, 1, 1))
        begin = 0
        for view, scene in enumerate(self.scenes):
            slots = self.table.slot[self.table.view == view]
            part = slice(begin, begin + len(slots))
            begin += len(slots)
            if step < len(scene):
                asked[part] = scene.asked[step, slots]
                starting[part] = asked[part] & ~scene.asked[:step, slots].any(axis=0)
                poses[part] = np.where(asked[part, None, None], scene.poses[step, slots], np.eye(4))
        return FrameTruth(asked, starting, poses)


def make_group(scenes: Sequence[Scene], object_ids: Sequence[int]) -> Group:
    """List the instances that are to be estimated in any frame, by scene, then by slot.

    Args:
        scenes: The scenes.
        object_ids: obj_id of each model.
    """
    models = {object_id: index for index, object_id in enumerate(object_ids)}
    slots = [np.flatnonzero(scene.asked.any(axis=0)) for scene in scenes]
    return Group(
        tuple(scenes),
        InstanceTable(
            view=np.repeat(np.arange(len(scenes)), [len(part) for part in slots]).astype(np.int32),
            slot=np.concatenate([*slots, np.empty(0)]).astype(np.int32),
            model=np.array(
                [models[object_id] for scene, part in zip(scenes, slots, strict=True) for object_id in scene.object_ids[part].tolist()],
                np.int32,
            ),
        ),
    )


def ask(scene: Scene, method: str, min_visibility: float, objects: Sequence[frozenset[int] | None]) -> Scene:
    """Select the instances to estimate in each frame.

    Tracks are asked in all frames from the first one on in which the instance is visible enough, as long as the image has it. Other
    methods are asked where it is visible enough, and of an object that counts.

    Args:
        scene: The scene.
        method: One of METHODS.
        min_visibility: Smallest visible fraction.
        objects: obj_ids that count in each planned frame; None: all.
    """
    present = scene.index != ABSENT
    asked = present & ~(scene.visibility < min_visibility) & (scene.boxes[..., 2] >= 0)
    if method == TRACK:
        return replace(scene, asked=present & np.logical_or.accumulate(asked, axis=0))
    for row, known in enumerate(objects):
        if known is not None:
            asked[row] &= np.isin(scene.object_ids, sorted(known))
    return replace(scene, asked=asked)


def estimate_frame(method: str, estimator: Estimator, batch: RgbdBatch, group: Group, step: int, seed: int) -> Estimates:
    """Run a method on one frame of each scene.

    Args:
        method: One of METHODS.
        estimator: Of the group's instances.
        batch: Images of the step.
        group: The scenes.
        step: Index among their planned frames.
        seed: Seed of disturbed poses.

    Returns:
        Estimates; `valid` only where asked. Tracks that start in this frame have the truth with score 1.
    """
    truth = group.truth(step)
    if method == SINGLE:
        result = estimator.estimate(batch)
    elif method == TRACK:
        if truth.starting.any():
            estimator.start(to_transforms(truth.poses), truth.starting)
        result = estimator.track(batch)
        pose, score = np.array(result.pose), np.array(result.score)
        pose[truth.starting], score[truth.starting] = to_transforms(truth.poses)[truth.starting], 1.0
        result = replace(result, pose=pose, score=score, valid=result.valid | truth.starting)
    else:
        result = estimator.refine(batch, to_transforms(_disturb(truth, group, step, seed)))
    return replace(result, valid=result.valid & truth.asked)


def _disturb(truth: FrameTruth, group: Group, step: int, seed: int) -> np.ndarray:
    """Perturbed ground-truth poses (N, 4, 4) of the instances to estimate; the identity for others."""
    poses = truth.poses.copy()
    for view, scene in enumerate(group.scenes):
        rows = np.flatnonzero(truth.asked & (group.table.view == view))
        if len(rows):
            instances = scene.instances[group.table.slot[rows]]
            poses[rows] = disturb_poses(poses[rows], instances, seed, scene.plan.scene, scene.plan.frames[step])
    return poses


def to_transforms(poses: np.ndarray) -> np.ndarray:
    """Convert poses (N, 4, 4) to translations and quaternions x, y, z, w (N, 7) float32."""
    if not len(poses):
        return np.empty((0, 7), np.float32)
    return np.concatenate((poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()), axis=1).astype(np.float32)


def to_rotations(transforms: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) float64 of transforms (N, 7), whose quaternions must not be zero."""
    if not len(transforms):
        return np.empty((0, 3, 3))
    return Rotation.from_quat(transforms[:, 3:].astype(np.float64)).as_matrix()
