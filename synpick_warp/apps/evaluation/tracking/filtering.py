"""Recursive pose filter of the paper: exponential moving average (EMA) of the position, slerp of the rotation on the shorter arc.

    t̂_n = (1 - α) t̂_(n-1) + α t_n        q̂_n = slerp(q̂_(n-1), q_n, α)

α weighs the new estimate (Periyasamy et al., SynPick, 2021, section "6D Pose Tracking"): 0.05 smooths much, 1 changes nothing. At rest the
variance of white noise falls by α / (2 - α); at constant velocity v the filtered position lags by v Δt (1 - α) / α, which is 19 frames at
α = 0.05 and 4 at 0.2; a rotation at constant rate likewise.

What the paper leaves open, and what is chosen here:

- The first estimate of a track starts it: t̂_0 = t_0, q̂_0 = q_0.
- Slerp goes along the shorter arc, whichever of q and -q an estimator gives; at exactly 180° either arc is as short, and one is taken.
- A frame without an estimate is no step: the track waits, the next estimate weighs α again, and no row is invented for the frame.
- Symmetric objects: nothing is done, so that an estimate that jumps to an equivalent pose pulls the filtered one through poses between.
  With `symmetries` each estimate is first replaced by the equivalent pose next to the filtered rotation.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.tracking.tracks import check_poses, find_tracks
from synpick_warp.errors import ConfigError, DatasetError

PAPER_ALPHAS = (0.05, 0.2)
"""Weights of the new estimate in the paper's table and figure; the first is the better one."""


def filter_poses(
    table: PoseTable,
    alpha: float = PAPER_ALPHAS[0],
    *,
    tracks: np.ndarray | None = None,
    symmetries: Mapping[int, np.ndarray] | None = None,
) -> PoseTable:
    """Filter each track from its first image to its last.

    Args:
        table: N estimates, in any order.
        alpha: Weight of the new estimate, above 0 and at most 1.
        tracks: Track index of each row (N,) int64, at most one row of a track an image; None: `find_tracks(table)`.
        symmetries: obj_id -> transforms of the model onto itself (K, 4, 4) [m], with the identity; None: as in the paper.

    Returns:
        The table with filtered poses, in the order of its rows; everything else is unchanged.

    Raises:
        ConfigError: alpha is out of range.
        DatasetError: A pose is not finite, a rotation is singular, or `tracks` does not fit.
    """
    check_alpha(alpha)
    check_poses(table)
    tracks = find_tracks(table) if tracks is None else _check_tracks(table, tracks)
    if not len(table):
        return table
    measured = _to_quaternions(table.rotation, "the estimates")
    steps = _steps(tracks, table.image)
    translation, rotation = _run_filter(table.translation, measured, steps, alpha, _Symmetries(table, symmetries or {}))
    columns = {name: getattr(table, name) for name in table.__dataclass_fields__}
    return PoseTable(**columns | {"translation": translation, "rotation": rotation})


def check_alpha(alpha: float) -> None:
    """Raise ConfigError unless alpha is a weight of the new estimate: above 0, at most 1."""
    if not 0.0 < alpha <= 1.0:
        raise ConfigError(
            f"alpha {alpha} is not allowed: it is the weight of the new estimate, above 0 and at most 1 (paper: 0.05 and 0.2)"
        )


def _to_quaternions(matrices: np.ndarray, source: str) -> np.ndarray:
    """Quaternions (N, 4), scalar last, of the rotations next to matrices (N, 3, 3); DatasetError if one is singular or left-handed."""
    try:
        return Rotation.from_matrix(matrices).as_quat()
    except ValueError:
        wrong = int(np.argmin(np.linalg.det(matrices)))
        raise DatasetError(f"matrix {wrong} of {source} is no rotation; rotations are orthonormal with determinant 1") from None


def _check_tracks(table: PoseTable, tracks: np.ndarray) -> np.ndarray:
    """Check given track indices (N,): of all rows, at most one row an image, one scene and one object each."""
    tracks = np.asarray(tracks)
    if tracks.shape != (len(table),):
        raise DatasetError(f"tracks have shape {tracks.shape} and the table {len(table)} rows; give one track index a row")
    order = np.lexsort((table.image, tracks))
    key, scene, object_id, image = (column[order] for column in (tracks, table.scene, table.object_id, table.image))
    wrong = (key[1:] == key[:-1]) & ((scene[1:] != scene[:-1]) | (object_id[1:] != object_id[:-1]) | (image[1:] == image[:-1]))
    if wrong.any():
        track = key[int(np.argmax(wrong))]
        raise DatasetError(
            f"track {track} mixes scenes or objects, or has two rows of an image; use find_tracks, which gives tracks of one each"
        )
    return tracks


def _steps(tracks: np.ndarray, image: np.ndarray) -> list[np.ndarray]:
    """Rows of the n-th estimate of each track, for every n; the longest track first, so that tracks end from the back."""
    order = np.lexsort((image, tracks))
    _, start, length = np.unique(tracks[order], return_index=True, return_counts=True)
    longest = np.argsort(-length, kind="stable")
    start, length = start[longest], length[longest]
    alive = np.searchsorted(-length, -np.arange(length[0]), side="left")
    return [order[start[:count] + step] for step, count in enumerate(alive)]


def _run_filter(
    position: np.ndarray, measured: np.ndarray, steps: list[np.ndarray], alpha: float, symmetries: _Symmetries
) -> tuple[np.ndarray, np.ndarray]:
    """Run the recursion on all tracks at once: one NumPy step per frame.

    Args:
        position: Measured translation (N, 3) [m].
        measured: Measured rotation as quaternion (N, 4), scalar last.
        steps: Rows of the n-th estimate of each track, as `_steps` gives them.
        alpha: Weight of the new estimate.
        symmetries: Equivalent poses.

    Returns:
        Filtered translation (N, 3) [m] and rotation (N, 3, 3).
    """
    translation, quaternion = np.array(position), np.array(measured)
    mean, state = position[steps[0]], measured[steps[0]]
    for rows in steps[1:]:
        turn = Rotation.from_quat(state[: len(rows)])
        new_position, new_quaternion = symmetries.nearest(rows, turn, position[rows], measured[rows])
        mean = (1.0 - alpha) * mean[: len(rows)] + alpha * new_position
        # Slerp as a fraction of the relative rotation: a rotation vector has at most 180°, hence the shorter arc.
        relative = turn.inv() * Rotation.from_quat(new_quaternion)
        state = (turn * Rotation.from_rotvec(alpha * relative.as_rotvec())).as_quat()
        translation[rows], quaternion[rows] = mean, state
    return translation, Rotation.from_quat(quaternion).as_matrix()


class _Symmetries:
    """Equivalent poses of symmetric objects: for each obj_id the rigid transforms under which it looks the same."""

    def __init__(self, table: PoseTable, symmetries: Mapping[int, np.ndarray]) -> None:
        self._object_id = table.object_id
        self._transforms: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """obj_id -> quaternions (K, 4) and translations (K, 3) [m]."""
        for object_id, transforms in symmetries.items():
            transforms = np.asarray(transforms, np.float64)
            if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or not len(transforms) or not np.isfinite(transforms).all():
                raise DatasetError(f"symmetries of object {object_id} have shape {transforms.shape}; give finite transforms (K, 4, 4)")
            self._transforms[object_id] = (
                _to_quaternions(transforms[:, :3, :3], f"the symmetries of object {object_id}"),
                transforms[:, :3, 3],
            )

    def nearest(self, rows: np.ndarray, turn: Rotation, position: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace estimates by their equivalents with the smallest angle to the filtered rotations.

        Args:
            rows: Rows of the table (n,).
            turn: Filtered rotations (n).
            position: Measured translation (n, 3) [m].
            measured: Measured quaternion (n, 4).

        Returns:
            Translation (n, 3) [m] and quaternion (n, 4).
        """
        state = turn.as_quat()
        for object_id, (rotations, shifts) in self._transforms.items():
            chosen = np.flatnonzero(self._object_id[rows] == object_id)
            if not len(chosen):
                continue
            count = len(rotations)
            every = np.repeat(chosen, count)
            equivalent = (Rotation.from_quat(measured[every]) * Rotation.from_quat(np.tile(rotations, (len(chosen), 1)))).as_quat()
            # The angle between two rotations falls as the product of their quaternions grows in size.
            likeness = np.abs((state[every] * equivalent).sum(axis=1)).reshape(-1, count)
            best = np.argmax(likeness, axis=1)
            position, turned = position.copy(), Rotation.from_quat(measured[chosen])
            position[chosen] += turned.apply(shifts[best])
            measured = measured.copy()
            measured[chosen] = equivalent[np.arange(len(chosen)) * count + best]
        return position, measured
