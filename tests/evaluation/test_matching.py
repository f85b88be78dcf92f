"""Greedy matching: hand-made cases, and the BOP toolkit's algorithm on random ones."""

from __future__ import annotations

import time

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.apps.evaluation.matching import ALL, PER_INSTANCE, make_pairs, match
from synpick_warp.apps.evaluation.poses import PoseTable
from tests.harness.fuzz import fuzz_examples
from tests.twins import pose_errors as twin


def table(keys: list[tuple[int, int, int]], scores: list[float] | None = None) -> PoseTable:
    """Poses of (scene, image, object), sorted as tables are."""
    columns = np.reshape(np.array(keys, np.int64), (-1, 3))
    order = np.lexsort(columns.T[::-1])
    count = len(columns)
    values = np.ones(count) if scores is None else np.array(scores, np.float64)
    unknown = np.full(count, -1)
    poses = PoseTable(*columns.T, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), values, -np.ones(count), unknown)
    return poses.select(order)


def test_estimates_meet_instances_of_the_same_image_and_object():
    truth = table([(0, 0, 1), (0, 0, 1), (0, 0, 2), (0, 1, 1)])
    estimates = table([(0, 0, 1), (0, 0, 2), (0, 0, 3), (0, 2, 1)])
    pairs = make_pairs(truth, np.ones(4, bool), estimates)
    assert list(zip(pairs.estimate, pairs.truth, strict=True)) == [(0, 0), (0, 1), (1, 2)]


def test_only_the_best_estimates_count():
    truth = table([(0, 0, 1), (0, 0, 1)])
    estimates = table([(0, 0, 1)] * 4, [0.1, 0.9, 0.5, 0.9])
    for top, expected in ((PER_INSTANCE, [1, 3]), (ALL, [1, 3, 2, 0]), (1, [1])):
        pairs = make_pairs(truth, np.ones(2, bool), estimates, top)
        assert pairs.estimate[::2].tolist() == expected
    pairs = make_pairs(truth, np.array([False, True]), estimates)
    assert (pairs.estimate.tolist(), pairs.truth.tolist()) == ([1], [1])


def test_the_better_score_chooses_first_though_another_fits_better():
    truth, estimates = table([(0, 0, 1), (0, 0, 1)]), table([(0, 0, 1)] * 2, [0.5, 0.9])
    pairs = make_pairs(truth, np.ones(2, bool), estimates)
    assert pairs.estimate.tolist() == [1, 1, 0, 0]
    assert match(pairs, np.array([0.02, 0.03, 0.01, 0.2]), 0.1, 2).tolist() == [0, -1]
    assert match(pairs, np.array([0.02, 0.03, 0.01, 0.04]), 0.1, 2).tolist() == [0, 3]


def test_an_error_at_the_threshold_is_no_match():
    truth, estimates = table([(0, 0, 1)]), table([(0, 0, 1)])
    pairs = make_pairs(truth, np.ones(1, bool), estimates)
    assert match(pairs, np.array([0.1]), 0.1, 1).tolist() == [-1]
    assert match(pairs, np.array([np.inf]), 0.1, 1).tolist() == [-1]


def test_no_estimates_and_no_targets():
    some, none = table([(0, 0, 1)]), table([])
    for truth, estimates, target in ((some, none, [True]), (none, some, []), (some, some, [False]), (none, none, [])):
        pairs = make_pairs(truth, np.array(target, bool), estimates)
        assert len(pairs.truth) == 0
        assert match(pairs, np.empty(0), 0.1, len(truth)).tolist() == [-1] * len(truth)


def test_many_hypotheses_take_as_many_rounds_as_instances():
    count = 20_000
    truth, estimates = table([(0, 0, 1), (0, 0, 1)]), table([(0, 0, 1)] * count, np.linspace(1.0, 0.0, count).tolist())
    pairs = make_pairs(truth, np.ones(2, bool), estimates, ALL)
    errors = np.where(pairs.truth == 0, 0.01, 0.02)
    started = time.monotonic()
    assert match(pairs, errors, 0.1, 2).tolist() == [0, 3]
    assert time.monotonic() - started < 5.0


KEYS = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 1), st.integers(1, 2)), max_size=12)


@given(keys=KEYS, others=KEYS, data=st.data())
@settings(max_examples=fuzz_examples(150))
def test_matching_is_the_toolkits(keys, others, data):
    draw = data.draw
    truth = table(keys)
    estimates = table(others, draw(st.lists(st.sampled_from([0.1, 0.5, 0.9]), min_size=len(others), max_size=len(others))))
    target = np.array(draw(st.lists(st.booleans(), min_size=len(keys), max_size=len(keys))), bool)
    top = draw(st.sampled_from([PER_INSTANCE, ALL, 1, 2]))
    pairs = make_pairs(truth, target, estimates, top)
    levels = [0.0, 0.01, 0.05, 0.1, 0.2]
    errors = np.array(draw(st.lists(st.sampled_from(levels), min_size=len(keys) * len(others), max_size=len(keys) * len(others))))
    errors = errors.reshape(len(others), len(keys))
    found = match(pairs, errors[pairs.estimate, pairs.truth], 0.1, len(truth))
    expected = np.full(len(truth), -1)
    for key in sorted(set(keys)):
        ours, theirs = (
            np.flatnonzero((poses.scene == key[0]) & (poses.image == key[1]) & (poses.object_id == key[2])) for poses in (truth, estimates)
        )
        limit = {PER_INSTANCE: int(target[ours].sum()), ALL: len(theirs)}.get(top, top)
        theirs = theirs[np.argsort(-estimates.score[theirs], kind="stable")][:limit]
        matched = twin.match_poses(estimates.score[theirs].tolist(), errors[np.ix_(theirs, ours)], 0.1, target[ours].tolist())
        for instance, estimate in matched.items():
            expected[ours[instance]] = theirs[estimate]
    assert [pairs.estimate[index] if index >= 0 else -1 for index in found] == expected.tolist()
    assert all(pairs.truth[index] == row for row, index in enumerate(found) if index >= 0)
