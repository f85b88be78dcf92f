"""Scoring of pose estimates: errors of the matched estimate of every true instance, infinite where none was found.

Each of ADD, ADD-S and ADD(-S) is matched by itself, as the BOP toolkit matches each error function: an instance that one of them finds may
be missed by another. Rotation and translation errors are those of the match by ADD(-S).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from synpick_warp.apps.evaluation.auc import LIMIT
from synpick_warp.apps.evaluation.errors import add_errors, adds_errors, rotation_errors, translation_errors
from synpick_warp.apps.evaluation.matching import PER_INSTANCE, Pairs, make_pairs, match
from synpick_warp.apps.evaluation.models import Model
from synpick_warp.apps.evaluation.nearest import NEAR
from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.truth import Truth

METRICS = ("ADD", "ADD-S", "ADD(-S)")
"""ADD(-S) is ADD-S for objects with symmetries in models_info.json, ADD for others."""
MIN_VISIBILITY = 0.1
"""Smallest visible fraction of a target, as in BOP."""
PoseStep = Callable[[PoseTable], PoseTable]
"""Change of the estimates before they are scored, such as a filter over time."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Errors of one method for the T true instances that are visible enough."""

    name: str
    """Name of the method."""
    target: np.ndarray
    """Row of the ground truth (T,) int64."""
    errors: dict[str, np.ndarray]
    """Metric -> (T,) [m]; infinity: missed."""
    rotation: np.ndarray
    """Rotation error, the smallest over the object's symmetries (T,) [°]; NaN: missed by ADD(-S)."""
    translation: np.ndarray
    """Translation error (T,) [m]; NaN: missed by ADD(-S)."""
    seconds: float
    """Mean time per image [s]; NaN: unknown."""


def score(
    name: str,
    truth: Truth,
    estimates: PoseTable,
    models: Mapping[int, Model],
    min_visibility: float = MIN_VISIBILITY,
    top: int = PER_INSTANCE,
    steps: Sequence[PoseStep] = (),
) -> Scores:
    """Score pose estimates of a data set.

    Args:
        name: Name of the method.
        truth: Ground truth.
        estimates: Estimated poses of any scenes of the data set; images without estimates count as misses.
        models: Models of all objects of the ground truth.
        min_visibility: Smallest visible fraction of a target; instances below are neither found nor missed.
        top: Maximum number of estimates per image and object; see `matching`.
        steps: Changes of the estimates before they are scored, in order.
    """
    for step in steps:
        estimates = step(estimates)
    target = truth.shown(min_visibility)
    pairs = make_pairs(truth.poses, target, estimates, top)
    pair_errors = _pair_errors(truth.poses, estimates, pairs, models)
    matches = {metric: match(pairs, pair_errors[metric], LIMIT, len(truth)) for metric in METRICS}
    rows = np.flatnonzero(target)
    errors = {}
    for metric, found in matches.items():
        errors[metric] = np.full(len(rows), np.inf)
        hit = found[rows] >= 0
        errors[metric][hit] = pair_errors[metric][found[rows][hit]]
    rotation, translation = _motion_errors(truth.poses, estimates, pairs, matches["ADD(-S)"][rows], models)
    return Scores(name, rows, errors, rotation, translation, mean_seconds(estimates))


def _pair_errors(truth: PoseTable, estimates: PoseTable, pairs: Pairs, models: Mapping[int, Model]) -> dict[str, np.ndarray]:
    """Metric -> error of each pair (P,) [m]; infinity where a bound shows that it is above LIMIT, so that no match could have it."""
    errors = {metric: np.full(len(pairs.estimate), np.inf) for metric in METRICS}
    object_ids = truth.object_id[pairs.truth]
    for object_id in np.unique(object_ids):
        model = models[int(object_id)]
        rows = np.flatnonzero(object_ids == object_id)
        ours, theirs = truth.select(pairs.truth[rows]), estimates.select(pairs.estimate[rows])
        offset = (theirs.rotation - ours.rotation) @ model.search.center + theirs.translation - ours.translation
        distance = np.linalg.norm(offset, axis=1)
        # A mean of lengths is at least the length of the mean; a nearest vertex is not nearer than the bounding sphere.
        near = np.flatnonzero(distance < LIMIT)
        errors["ADD"][rows[near]] = add_errors(*_poses(theirs, near), *_poses(ours, near), model.vertices)
        near = np.flatnonzero(distance < LIMIT + NEAR * model.search.radius)
        errors["ADD-S"][rows[near]] = adds_errors(*_poses(theirs, near), *_poses(ours, near), model.vertices, model.search)
        errors["ADD(-S)"][rows] = errors["ADD-S" if model.symmetric else "ADD"][rows]
    return errors


def _poses(table: PoseTable, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) and translations (N, 3) of rows."""
    return table.rotation[rows], table.translation[rows]


def _motion_errors(
    truth: PoseTable, estimates: PoseTable, pairs: Pairs, found: np.ndarray, models: Mapping[int, Model]
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (T,) [°] and translation (T,) [m] errors of matched pairs; NaN for index -1."""
    rotation, translation = np.full(len(found), np.nan), np.full(len(found), np.nan)
    hits = np.flatnonzero(found >= 0)
    ours, theirs = truth.select(pairs.truth[found[hits]]), estimates.select(pairs.estimate[found[hits]])
    translation[hits] = translation_errors(theirs.translation, ours.translation)
    for object_id in np.unique(ours.object_id):
        rows = np.flatnonzero(ours.object_id == object_id)
        rotation[hits[rows]] = rotation_errors(theirs.rotation[rows], ours.rotation[rows], models[int(object_id)].symmetries)
    return rotation, translation


def mean_seconds(estimates: PoseTable) -> float:
    """Mean time per image [s] over the images whose time is known; NaN: none is."""
    known = estimates.select(estimates.seconds >= 0.0)
    if not len(known):
        return float("nan")
    keys = np.stack((known.scene, known.image), axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    return float(known.seconds[first].mean())
