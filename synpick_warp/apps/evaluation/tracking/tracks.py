"""Multi-object data association: per-image pose estimates linked to one track per object instance over an episode's camera.

The paper (Periyasamy et al., SynPick, 2021) filters "the estimate at frame n of the sequence" and states no association rule. In its
picking scenes an object occurs at most once, so that scene and object identify a track; that case is kept exactly, whatever the jumps.
What it leaves open, and what is chosen here:

- Several instances of an object (scenes of mode `move`): in each image, the one-to-one assignment of estimates to tracks of least total
  distance (Kuhn, 1955). A track is where the medoid of its last five estimates is: one outlier does not move it, nor the choice of axes.
- A track begins only where an image has more estimates than there are tracks; no distance is too far unless a `gate` is given.
- Missing frames: a track waits, however long, unless `max_gap` is given.
- Rows with a known instance form tracks by that instance.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.errors import ConfigError, DatasetError

_HISTORY = 5
"""Number of estimates whose medoid is a track's position: outliers up to two in succession are outvoted, motion lags by two frames."""
_MAX_COORDINATE = 1e6
"""Largest coordinate of a translation [m]: far beyond every scene, small enough to compute with."""
_MAX_ENTRY = 1.01
"""Largest entry of a rotation, with the rounding of files."""
_TOO_FAR = 1e9
"""Cost of a pair beyond the gate [m]: above every sum of allowed ones, so that the assignment uses it only where nothing else is left."""


def find_tracks(table: PoseTable, gate: float | None = None, max_gap: int | None = None) -> np.ndarray:
    """Associate rows to tracks; a track has one scene (episode and camera), one object, and at most one row an image.

    The result does not depend on the order of rows, except among rows that are equal in scene, image, object, instance, score and pose.

    Args:
        table: N estimates; rows with instance >= 0 are associated among their instance only.
        gate: Largest distance between an estimate and its track's position [m]; None: any, as in the paper.
        max_gap: Largest number of frames from one estimate of a track to its next; None: any, as in the paper.

    Returns:
        Track index of each row (N,) int64, from 0; tracks are sorted by scene, object, instance and first image.

    Raises:
        ConfigError: A gate or gap is not positive.
        DatasetError: A pose is not finite, or a column has another length or shape.
    """
    if gate is not None and not gate > 0.0:
        raise ConfigError(f"gate {gate} m is not allowed: the distance to a track is above 0; leave it out for none")
    if max_gap is not None and not max_gap >= 1:
        raise ConfigError(f"max_gap {max_gap} is not allowed: successive frames are 1 apart; leave it out for any gap")
    check_poses(table)
    tracks = np.empty(len(table), np.int64)
    order = _canonical_order(table)
    key = np.stack([column[order] for column in (table.scene, table.object_id, table.instance)], axis=1)
    count = 0
    for group in np.split(order, 1 + np.flatnonzero((key[1:] != key[:-1]).any(axis=1))) if len(order) else ():
        image = table.image[group]
        if gate is None and (image[1:] != image[:-1]).all():
            local = _split_at_gaps(image, max_gap)
        else:
            local = _assign(image, table.translation[group], gate, max_gap)
        tracks[group] = count + local
        count += int(local.max()) + 1
    return tracks


def check_poses(table: PoseTable) -> None:
    """Check that columns have the table's shapes, and that poses are finite and in range.

    Raises:
        DatasetError: They are not; names the column, or scene and image of the first such row.
    """
    shapes = {"rotation": (len(table), 3, 3), "translation": (len(table), 3)}
    for name in table.__dataclass_fields__:
        shape, wanted = np.shape(getattr(table, name)), shapes.get(name, (len(table),))
        if shape != wanted:
            raise DatasetError(f"column {name} of the poses has shape {shape} instead of {wanted}; build the table with all rows")
    # A comparison with NaN is false.
    usable = (np.abs(table.translation) <= _MAX_COORDINATE).all(axis=1) & (np.abs(table.rotation) <= _MAX_ENTRY).all(axis=(1, 2))
    if not usable.all():
        row = int(np.argmin(usable))
        place = f"scene {table.scene[row]}, image {table.image[row]}, object {table.object_id[row]}"
        raise DatasetError(f"the pose of {place} is not finite, or is no pose in metres; a failed estimate is a missing row")


def _canonical_order(table: PoseTable) -> np.ndarray:
    """Order by scene, object, instance, image, falling score and pose: the same estimates have the same order however rows came (N,)."""
    pose = np.concatenate((table.translation, table.rotation.reshape(-1, 9)), axis=1)
    return np.lexsort((*pose.T[::-1], -table.score, table.image, table.instance, table.object_id, table.scene))


def _split_at_gaps(image: np.ndarray, max_gap: int | None) -> np.ndarray:
    """Tracks of rows of different images, sorted: one, or one for each stretch without a gap above `max_gap`."""
    if max_gap is None:
        return np.zeros(len(image), np.int64)
    return np.concatenate(([0], np.cumsum(np.diff(image) > max_gap)))


def _assign(image: np.ndarray, position: np.ndarray, gate: float | None, max_gap: int | None) -> np.ndarray:
    """Associate the estimates of a group frame by frame.

    Args:
        image: Image of each row (n,), sorted.
        position: Translation (n, 3) [m].
        gate: As `find_tracks`, in metres.
        max_gap: As `find_tracks`, in frames.

    Returns:
        Track of each row (n,), from 0 in order of their first images.
    """
    tracks = np.empty(len(image), np.int64)
    starts = np.concatenate(([0], 1 + np.flatnonzero(image[1:] != image[:-1]), [len(image)]))
    history = np.empty((len(image), _HISTORY, 3))
    last = np.empty(len(image), np.int64)
    count = 0
    for start, end in itertools.pairwise(starts):
        now, seen = image[start], position[start:end]
        live = np.flatnonzero(now - last[:count] <= (math.inf if max_gap is None else max_gap))
        distance = np.linalg.norm(seen[:, None] - _medoids(history[live])[None], axis=2)
        rows, columns = linear_sum_assignment(distance if gate is None else np.where(distance <= gate, distance, _TOO_FAR))
        allowed = distance[rows, columns] <= (math.inf if gate is None else gate)
        rows, chosen = rows[allowed], live[columns[allowed]]
        history[chosen, :-1] = history[chosen, 1:]
        history[chosen, -1] = seen[rows]
        track = np.full(end - start, -1)
        track[rows] = chosen
        new = np.flatnonzero(track < 0)
        track[new] = count + np.arange(len(new))
        history[track[new]] = seen[new, None]
        count += len(new)
        last[track] = now
        tracks[start:end] = track
    return tracks


def _medoids(points: np.ndarray) -> np.ndarray:
    """Of each set of points (n, k, 3), the one with the least total distance to the others (n, 3)."""
    total = np.linalg.norm(points[:, :, None] - points[:, None], axis=3).sum(axis=2)
    return points[np.arange(len(points)), np.argmin(total, axis=1)]


def track_of_instance(truth: PoseTable, table: PoseTable, tracks: np.ndarray) -> np.ndarray:
    """Find the track of a true instance: in each image the nearest estimate votes for its track; ties go to the lower index.

    Args:
        truth: True poses of one instance: one scene, one object, one row an image.
        table: N estimates.
        tracks: Track of each row (N,), as `find_tracks` gives them.

    Returns:
        Rows of the track (n,) int64, sorted by image; empty if the instance was never estimated.

    Raises:
        DatasetError: `truth` has several scenes or objects, or several rows of an image.
    """
    scenes, objects, images = (np.unique(column) for column in (truth.scene, truth.object_id, truth.image))
    if len(scenes) > 1 or len(objects) > 1 or len(images) < len(truth):
        raise DatasetError("the true poses are of several instances; select the rows of one scene and one instance")
    rows = np.flatnonzero(np.isin(table.scene, scenes) & np.isin(table.object_id, objects) & np.isin(table.image, images))
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
