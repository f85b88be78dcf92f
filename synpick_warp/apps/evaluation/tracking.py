"""Tracking over time: data association of estimates, the recursive filter of the SynPick paper, and the sweep of its weight.

The filter is an exponential moving average (EMA) of the position, and slerp of the rotation on the shorter arc:

    t̂_n = (1 - α) t̂_(n-1) + α t_n        q̂_n = slerp(q̂_(n-1), q_n, α)

α weighs the new estimate (Periyasamy et al., SynPick, 2021, section "6D Pose Tracking"): 0.05 smooths much, 1 changes nothing. At rest the
variance of white noise falls to α / (2 - α) of itself; at constant velocity v the filtered position lags by v Δt (1 - α) / α, which is 19
frames at α = 0.05 and 4 at 0.2; a rotation at constant rate likewise.

In the paper's picking scenes an object occurs at most once, so that scene and object identify a track; that case is kept exactly, whatever
the jumps. What the paper leaves open, and what is chosen here:

- Several instances of an object (scenes of mode `move`): in each image, the one-to-one assignment of estimates to tracks of least total
  distance (Kuhn, 1955). A track is where the medoid of its last five estimates is: one outlier does not move it, nor the choice of axes.
- A track begins only where an image has more estimates than there are tracks. Rows with a known instance form tracks by that instance.
- The first estimate of a track starts it: t̂_0 = t_0, q̂_0 = q_0.
- A frame without an estimate is no step: the track waits, the next estimate weighs α again, and no row is invented for the frame.
- Symmetric objects: nothing is done, so that an estimate that jumps to an equivalent pose pulls the filtered one through poses between.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.truth import PoseTable
from synpick_warp.errors import ConfigError, DatasetError

PAPER_ALPHAS = (0.05, 0.2)
"""Weights of the new estimate in the paper's table and figure; the first is the better one."""
SWEEP_ALPHAS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
"""Weights of a sweep: the paper's two among them, and 1, which changes nothing."""
_HISTORY = 5
"""Number of estimates whose medoid is a track's position: outliers up to two in succession are outvoted, motion lags by two frames."""
_MAX_COORDINATE = 1e6
"""Largest coordinate of a translation [m]: far beyond every scene, small enough to compute with."""
_MAX_ENTRY = 1.01
"""Largest entry of a rotation, with the rounding of files."""


def find_tracks(table: PoseTable) -> np.ndarray:
    """Associate rows to tracks, (N,) int64 from 0; a track has one scene (episode and camera), one object, and at most one row an image.

    Rows with an instance are associated among their instance only. Tracks are sorted by scene, object, instance and first image. The result
    does not depend on the order of rows, except among rows that are equal in scene, image, object, instance, score and pose. Raises
    DatasetError if a pose is not finite.
    """
    _check_poses(table)
    tracks = np.empty(len(table), np.int64)
    # By falling score and pose within an image, so that the same estimates have the same order however rows came.
    pose = np.concatenate((table.translation, table.rotation.reshape(-1, 9)), axis=1)
    order = np.lexsort((*pose.T[::-1], -table.score, table.image, table.instance, table.object_id, table.scene))
    key = np.stack([column[order] for column in (table.scene, table.object_id, table.instance)], axis=1)
    count = 0
    for group in np.split(order, 1 + np.flatnonzero((key[1:] != key[:-1]).any(axis=1))) if len(order) else ():
        image = table.image[group]
        single = (image[1:] != image[:-1]).all()
        local = np.zeros(len(group), np.int64) if single else _assign(image, table.translation[group])
        tracks[group] = count + local
        count += int(local.max()) + 1
    return tracks


def _check_poses(table: PoseTable) -> None:
    """Check that poses are finite and in range; raises DatasetError with scene and image of the first that is not."""
    # A comparison with NaN is false.
    usable = (np.abs(table.translation) <= _MAX_COORDINATE).all(axis=1) & (np.abs(table.rotation) <= _MAX_ENTRY).all(axis=(1, 2))
    if not usable.all():
        row = int(np.argmin(usable))
        place = f"scene {table.scene[row]}, image {table.image[row]}, object {table.object_id[row]}"
        raise DatasetError(f"the pose of {place} is not finite, or is no pose in metres; a failed estimate is a missing row")


def _assign(image: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Associate the estimates of a group frame by frame: track of each row (n,), from 0 in order of their first images, by the sorted
    images (n,) and translations (n, 3) [m]."""
    tracks = np.empty(len(image), np.int64)
    starts = np.concatenate(([0], 1 + np.flatnonzero(image[1:] != image[:-1]), [len(image)]))
    history = np.empty((len(image), _HISTORY, 3))
    count = 0
    for start, end in itertools.pairwise(starts):
        seen = position[start:end]
        distance = np.linalg.norm(seen[:, None] - _medoids(history[:count])[None], axis=2)
        rows, chosen = linear_sum_assignment(distance)
        history[chosen, :-1] = history[chosen, 1:]
        history[chosen, -1] = seen[rows]
        track = np.full(end - start, -1)
        track[rows] = chosen
        new = np.flatnonzero(track < 0)
        track[new] = count + np.arange(len(new))
        history[track[new]] = seen[new, None]
        count += len(new)
        tracks[start:end] = track
    return tracks


def _medoids(points: np.ndarray) -> np.ndarray:
    """Medoid of each point set (n, k, 3): the point with the least total distance to the others (n, 3)."""
    total = np.linalg.norm(points[:, :, None] - points[:, None], axis=3).sum(axis=2)
    return points[np.arange(len(points)), np.argmin(total, axis=1)]


def track_of_instance(truth: PoseTable, table: PoseTable, tracks: np.ndarray) -> np.ndarray:
    """Rows (n,) int64 of the track of a true instance, sorted by image: in each image the nearest estimate votes for its track; ties go to
    the lower index.

    `truth` has the true poses of one instance: one scene, one object, one row an image; `tracks` is the track of each of N estimates (N,),
    as `find_tracks` gives them. The result is empty if the instance was never estimated."""
    images = np.sort(truth.image)
    rows = np.flatnonzero((table.scene == truth.scene[0]) & (table.object_id == truth.object_id[0]) & np.isin(table.image, images))
    if not len(rows):
        return rows
    order = np.argsort(truth.image)
    place = truth.translation[order][np.searchsorted(images, table.image[rows])]
    distance = np.linalg.norm(table.translation[rows] - place, axis=1)
    ranked = rows[np.lexsort((tracks[rows], distance, table.image[rows]))]
    _, nearest = np.unique(table.image[ranked], return_index=True)
    names, votes = np.unique(tracks[ranked[nearest]], return_counts=True)
    members = np.flatnonzero(tracks == names[np.argmax(votes)])
    return members[np.argsort(table.image[members])]


def filter_poses(table: PoseTable, alpha: float = PAPER_ALPHAS[0], tracks: np.ndarray | None = None) -> PoseTable:
    """Filter each track from its first image to its last; returns the table with filtered poses, in the order of its rows. `alpha` weighs
    the new estimate, above 0 and at most 1; `tracks` are those of `find_tracks`, None: they are found. Raises ConfigError if alpha is out
    of range, and DatasetError if a pose is not finite, or a rotation is singular."""
    check_alpha(alpha)
    tracks = find_tracks(table) if tracks is None else tracks
    if not len(table):
        return table
    try:
        quaternion = Rotation.from_matrix(table.rotation).as_quat()
    except ValueError:
        wrong = int(np.argmin(np.linalg.det(table.rotation)))
        raise DatasetError(f"matrix {wrong} of the estimates is no rotation; rotations are orthonormal with determinant 1") from None
    translation, steps = np.array(table.translation), _steps(tracks, table.image)
    mean, state = translation[steps[0]], quaternion[steps[0]]
    # All tracks at once: one NumPy step per frame.
    for rows in steps[1:]:
        turn = Rotation.from_quat(state[: len(rows)])
        mean = (1.0 - alpha) * mean[: len(rows)] + alpha * translation[rows]
        # Slerp as a fraction of the relative rotation: a rotation vector has at most 180°, hence the shorter arc.
        relative = turn.inv() * Rotation.from_quat(quaternion[rows])
        state = (turn * Rotation.from_rotvec(alpha * relative.as_rotvec())).as_quat()
        translation[rows], quaternion[rows] = mean, state
    return replace(table, translation=translation, rotation=Rotation.from_quat(quaternion).as_matrix())


def check_alpha(alpha: float) -> None:
    """Raise ConfigError unless alpha is a weight of the new estimate: above 0, at most 1."""
    if not 0.0 < alpha <= 1.0:
        raise ConfigError(
            f"alpha {alpha} is not allowed: it is the weight of the new estimate, above 0 and at most 1 (paper: 0.05 and 0.2)"
        )


def _steps(tracks: np.ndarray, image: np.ndarray) -> list[np.ndarray]:
    """Rows of the n-th estimate of each track, for every n; the longest track first, so that tracks end from the back."""
    order = np.lexsort((image, tracks))
    _, start, length = np.unique(tracks[order], return_index=True, return_counts=True)
    longest = np.argsort(-length, kind="stable")
    start, length = start[longest], length[longest]
    alive = np.searchsorted(-length, -np.arange(length[0]), side="left")
    return [order[start[:count] + step] for step, count in enumerate(alive)]


@dataclass(frozen=True, eq=False)
class AlphaSweep:
    """Scores of a sweep over the tracking filter's weight alpha, by mode (M) and alpha (A), and unfiltered by mode."""

    modes: tuple[str, ...]
    """Names of the rows, in the order given."""
    alphas: tuple[float, ...]
    """Weights of the new estimate, rising."""
    scores: np.ndarray
    """Score of each mode and alpha (M, A) float64."""
    unfiltered: np.ndarray
    """Score of each mode's estimates as they came (M,) float64."""

    def best(self, mode: str) -> tuple[float, float]:
        """Best smoothing factor alpha of a mode, and its score; among ties the largest alpha, which lags least."""
        row = self.scores[self.modes.index(mode)]
        column = int(np.flatnonzero(row == row.max())[-1])
        return self.alphas[column], float(row[column])


def sweep_alpha(
    tables: Mapping[str, PoseTable], score: Callable[[str, PoseTable], float], alphas: Sequence[float] = SWEEP_ALPHAS
) -> AlphaSweep:
    """Filter and score the estimates of each mode with each alpha, rising, and score them unfiltered; tracks are found once a mode.

    The paper compares alpha 0.05 and 0.2 (table "Evaluation metrics"): a small alpha averages noise away, and lags behind what moves. A
    larger score of a mode's estimates is better; misses count against the truth of that mode's scenes only. Errors as of `filter_poses`.
    """
    scores, unfiltered = np.empty((len(tables), len(alphas))), np.empty(len(tables))
    for row, (mode, table) in enumerate(tables.items()):
        tracks = find_tracks(table)
        unfiltered[row] = score(mode, table)
        scores[row] = [score(mode, filter_poses(table, alpha, tracks)) for alpha in alphas]
    return AlphaSweep(tuple(tables), tuple(alphas), scores, unfiltered)


def split_by_mode(table: PoseTable, modes: Mapping[int, str]) -> dict[str, PoseTable]:
    """Split estimates by the mode of their scenes, in order of the modes' first scenes; `modes`: scene index -> mode."""
    names = dict.fromkeys(modes[scene] for scene in sorted(modes))
    return {name: table.select(np.isin(table.scene, [scene for scene in modes if modes[scene] == name])) for name in names}
