"""Scoring of pose estimates: errors of the matched estimate of every true instance, infinite where none was found.

Each of ADD, ADD-S and ADD(-S) is matched by itself, as the BOP toolkit matches each error function: an instance that one of them finds may
be missed by another. Rotation and translation errors are those of the match by ADD(-S).

Matching is greedy by descending score, as the BOP toolkit's `pose_matching.match_poses`. Estimates and instances meet per image and object.
An estimate takes, of the instances that are left, the one with the smallest error, if that is below the threshold. All images and objects
are worked on at once: a round matches the best remaining estimate of each.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from synpick_warp.apps.evaluation.errors import LIMIT, NEAR, Model, add_errors, adds_errors, rotation_errors, translation_errors
from synpick_warp.apps.evaluation.truth import PoseTable, Truth

METRICS = ("ADD", "ADD-S", "ADD(-S)")
"""ADD(-S) is ADD-S for objects with symmetries in models_info.json, ADD for others."""
MIN_VISIBILITY = 0.1
"""Smallest visible fraction of a target, as in BOP."""
PER_INSTANCE = -1
"""Of an image and object with n targets, the n best estimates count: n_top = -1 of the BOP toolkit's localization task."""
ALL = 0
"""All estimates count: n_top = 0."""


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
) -> Scores:
    """Score estimated poses of any scenes of a data set by the models of all objects of its ground truth; images without estimates count as
    misses, and instances below `min_visibility` are neither found nor missed. `top`: as of `make_pairs`."""
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


def _pair_errors(truth: PoseTable, estimates: PoseTable, pairs: "Pairs", models: Mapping[int, Model]) -> dict[str, np.ndarray]:
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
    truth: PoseTable, estimates: PoseTable, pairs: "Pairs", found: np.ndarray, models: Mapping[int, Model]
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


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of an estimate and a true instance of the same image and object, by group, then by descending score, then by instance."""

    estimate: np.ndarray
    """Row of the estimate (P,) int64."""
    truth: np.ndarray
    """Row of the instance (P,) int64."""
    group: np.ndarray
    """Index of the image and object (P,) int64, rising."""


def make_pairs(truth: PoseTable, target: np.ndarray, estimates: PoseTable, top: int = PER_INSTANCE) -> Pairs:
    """Pair the best estimates with the instances of the same image and object; equal scores keep the order of the file, as in the toolkit.

    `target`: whether an instance is to be found (N,) bool; others are no partners, yet images without targets have no estimates to count.
    `top`: maximum number of estimates per image and object; PER_INSTANCE: as many as targets; ALL."""
    truth_rows = np.flatnonzero(target)
    keys = [np.concatenate((getattr(truth, name)[truth_rows], getattr(estimates, name))) for name in ("scene", "image", "object_id")]
    group = _group_indices(keys)
    truth_group, estimate_group = group[: len(truth_rows)], group[len(truth_rows) :]
    truth_rows = truth_rows[np.argsort(truth_group, kind="stable")]
    counts = np.bincount(truth_group, minlength=int(group.max(initial=-1)) + 1)
    starts = np.cumsum(counts) - counts
    rows = np.lexsort((-estimates.score, estimate_group))
    rank = _ranks(estimate_group[rows])
    limit = counts[estimate_group[rows]] if top == PER_INSTANCE else np.full(len(rows), len(rows) if top == ALL else top)
    rows, rank = rows[rank < limit], rank[rank < limit]
    partners = counts[estimate_group[rows]]
    first = np.repeat(starts[estimate_group[rows]], partners)
    place = _ranks(np.repeat(np.arange(len(partners)), partners))
    return Pairs(
        np.repeat(rows, partners),
        truth_rows[first + place],
        np.repeat(estimate_group[rows], partners),
    )


def match(pairs: Pairs, errors: np.ndarray, threshold: float, instances: int) -> np.ndarray:
    """Match estimates to instances, each at most once, by errors (P,) below a threshold: index of each instance's pair (N,) int64, -1:
    missed. `instances` is the number N of rows of the true poses."""
    result = np.full(instances, -1, np.int64)
    left = np.flatnonzero(errors < threshold)
    while len(left):  # As many rounds as an image has instances of an object, since each round matches one of them.
        starts = np.flatnonzero(np.diff(pairs.group[left], prepend=-1))
        leaders = np.repeat(pairs.estimate[left[starts]], np.diff(starts, append=len(left)))
        leading = pairs.estimate[left] == leaders
        rows = left[leading]
        # By group, then by error; equal errors keep the order of the instances, as in the toolkit.
        rows = rows[np.lexsort((errors[rows], pairs.group[rows]))]
        best = rows[np.diff(pairs.group[rows], prepend=-1) != 0]
        result[pairs.truth[best]] = best
        left = left[~leading & (result[pairs.truth[left]] < 0)]
    return result


def _group_indices(keys: list[np.ndarray]) -> np.ndarray:
    """Dense index of each distinct combination of keys (N,) int64, in rising order of the keys."""
    order = np.lexsort(keys[::-1])
    new = np.zeros(len(order), bool)
    for key in keys:
        new[1:] |= np.diff(key[order]) != 0
    index = np.empty(len(order), np.int64)
    index[order] = np.cumsum(new)
    return index


def _ranks(groups: np.ndarray) -> np.ndarray:
    """Position of each entry in its run of equal values (N,)."""
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    return np.arange(len(groups)) - np.repeat(starts, np.diff(starts, append=len(groups)))
