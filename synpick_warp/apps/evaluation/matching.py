"""Greedy matching of pose estimates to true instances by descending score, as the BOP toolkit's `pose_matching.match_poses`.

Estimates and instances meet per image and object. An estimate takes, of the instances that are left, the one with the smallest error, if
that is below the threshold. All images and objects are worked on at once: a round matches the best remaining estimate of each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synpick_warp.apps.evaluation.poses import PoseTable

PER_INSTANCE = -1
"""Of an image and object with n targets, the n best estimates count: n_top = -1 of the BOP toolkit's localization task."""
ALL = 0
"""All estimates count: n_top = 0."""


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
    """Pair the best estimates with the instances of the same image and object.

    Equal scores keep the order of the file, as in the toolkit.

    Args:
        truth: True poses.
        target: Whether an instance is to be found (N,) bool; others are no partners, yet images without targets have no estimates to count.
        estimates: Estimated poses.
        top: Maximum number of estimates per image and object; PER_INSTANCE: as many as targets; ALL.
    """
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
    return Pairs(np.repeat(rows, partners), truth_rows[first + _ranks_of_runs(partners)], np.repeat(estimate_group[rows], partners))


def match(pairs: Pairs, errors: np.ndarray, threshold: float, instances: int) -> np.ndarray:
    """Match estimates to instances, each at most once.

    Args:
        pairs: Candidates.
        errors: Error of each pair (P,).
        threshold: A match has a smaller error.
        instances: Number of rows N of the true poses.

    Returns:
        Index of each instance's pair (N,) int64; -1: missed.
    """
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


def _ranks_of_runs(lengths: np.ndarray) -> np.ndarray:
    """0, 1, ... for every run (sum of lengths)."""
    ends = np.cumsum(lengths)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - lengths, lengths)
