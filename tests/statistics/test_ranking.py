"""AUC, calibration and bootstrap: known answers by hand, brute force over pairs, and intervals that cover what they should."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.apps.statistics.ranking import BINS, Scored, calibrate, estimate, success_rate, weighted_auc


def scored(score, outcome, weight=None, cluster=None) -> Scored:
    count = len(score)
    return Scored(
        np.array(score, float),
        np.array(outcome, bool),
        np.ones(count) if weight is None else np.array(weight, float),
        np.arange(count) if cluster is None else np.array(cluster),
    )


@pytest.mark.parametrize(
    ("score", "outcome", "weight", "area"),
    [
        ([0.1, 0.4, 0.35, 0.8], [0, 0, 1, 1], None, 0.75),  # Fawcett: 3 of 4 pairs are in order.
        ([0.1, 0.2, 0.3], [0, 1, 1], None, 1.0),
        ([0.3, 0.2, 0.1], [0, 1, 1], None, 0.0),
        ([0.5, 0.5, 0.5], [0, 1, 1], None, 0.5),
        ([0.5, 0.5, 0.9], [0, 1, 1], None, 0.75),  # A tie counts half.
        ([0.1, 0.4, 0.35, 0.8], [0, 0, 1, 1], [1, 3, 1, 1], (1 + 1 + 3) / 8),  # A weight of 3 is the sample three times.
        ([0.1, 0.4, 0.35, 0.8], [0, 0, 1, 1], [1, 0, 1, 1], 1.0),
        ([0.1, 0.2], [1, 1], None, np.nan),
        ([], [], None, np.nan),
    ],
)
def test_auc_of_a_few_samples(score, outcome, weight, area):
    np.testing.assert_allclose(weighted_auc(scored(score, outcome, weight)), area)


def test_auc_is_the_share_of_pairs_in_order():
    generator = np.random.default_rng(3)
    score, outcome, weight = generator.integers(0, 12, 200) / 11, generator.random(200) < 0.3, generator.random(200)
    order = np.sign(score[outcome][:, None] - score[~outcome]) / 2 + 0.5
    pairs = weight[outcome][:, None] * weight[~outcome]
    assert weighted_auc(scored(score, outcome, weight)) == pytest.approx((order * pairs).sum() / pairs.sum(), abs=1e-12)


def test_calibration_of_a_hand_made_table():
    """Two bins: 0.25 succeeds in 1 of 4, so it is calibrated; 0.95 in 1 of 2, an error of 0.45 for a third of the samples."""
    found = calibrate(scored([0.25] * 4 + [0.95] * 2, [1, 0, 0, 0, 1, 0]), draws=50)
    assert found.count.tolist() == [0, 0, 4, 0, 0, 0, 0, 0, 0, 2]
    np.testing.assert_allclose(found.predicted[[2, 9]], (0.25, 0.95))
    np.testing.assert_allclose(found.observed[[2, 9]], (0.25, 0.5))
    assert np.isnan(found.observed[[0, 5]]).all()
    assert found.error.value == pytest.approx(0.45 / 3)


def test_weights_of_calibration_are_repetitions():
    generator = np.random.default_rng(5)
    score, outcome, weight = generator.random(60), generator.random(60) < 0.5, generator.integers(1, 4, 60)
    once = calibrate(scored(score, outcome, weight, np.zeros(60)))
    many = calibrate(scored(*(np.repeat(each, weight) for each in (score, outcome)), cluster=np.zeros(weight.sum())))
    np.testing.assert_allclose(once.observed, many.observed)
    np.testing.assert_allclose(once.predicted, many.predicted)
    assert once.error.value == pytest.approx(many.error.value)
    assert len(once.count) == BINS
    assert np.isnan(once.error.low), "one cluster has no interval"


def test_intervals_widen_with_clusters_and_cover_the_truth():
    """100 data sets of 40 clusters whose success depends on the cluster: some 95 of 100 intervals over clusters hold the true rate, which
    those over samples miss often."""
    generator, held = np.random.default_rng(7), {True: 0, False: 0}
    for _ in range(100):
        rate = np.repeat(generator.choice((0.1, 0.9), 40), 25)
        outcome = generator.random(1000) < rate
        for clustered in held:
            groups = np.repeat(np.arange(40), 25) if clustered else np.arange(1000)
            found = estimate(scored(outcome, outcome, cluster=groups), success_rate, draws=100)
            held[clustered] += found.low <= 0.5 <= found.high
    assert held[True] >= 88
    assert held[False] <= 60
