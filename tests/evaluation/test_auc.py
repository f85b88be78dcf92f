"""Area under the accuracy-threshold curve: hand-computed values, the definition by numerical integration, PoseCNN's code."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.apps.evaluation.auc import LIMIT, band_indices, error_bands, exact_auc, recall_curve, vocap_auc
from tests.harness.fuzz import fuzz_examples
from tests.twins import pose_errors as twin

ERRORS = st.lists(st.one_of(st.floats(0.0, 0.2), st.sampled_from([0.0, 0.05, LIMIT, math.inf])), min_size=1, max_size=40)


def test_hand_computed_areas():
    assert exact_auc(np.zeros(3)) == vocap_auc(np.zeros(3)) == 1.0
    assert exact_auc(np.full(4, 0.05)) == pytest.approx(0.5)
    assert exact_auc(np.array([0.0, 0.05, np.inf, 0.3])) == pytest.approx(0.375)
    # VOCap: 1/2 over the first 5 cm, since the accuracy there is that of the error at its end; then 2/2.
    assert vocap_auc(np.array([0.05, 0.05])) == pytest.approx(0.75)
    assert vocap_auc(np.array([0.02, 0.06, np.inf, np.inf])) == pytest.approx((0.02 / 4 + 0.04 * 2 / 4 + 0.04 * 2 / 4) / 0.1)


def test_missing_detections_are_misses():
    assert exact_auc(np.full(3, np.inf)) == vocap_auc(np.full(3, np.inf)) == 0.0
    assert exact_auc(np.array([0.0, np.inf])) == pytest.approx(0.5)
    assert vocap_auc(np.array([0.0, np.inf])) == pytest.approx(0.5)
    assert math.isnan(exact_auc(np.empty(0)))
    assert math.isnan(vocap_auc(np.empty(0)))


@given(errors=ERRORS)
@settings(max_examples=fuzz_examples(200))
def test_exact_is_the_integral_of_the_recall_curve_and_vocap_is_posecnns(errors):
    values = np.array(errors)
    knots = np.unique(np.concatenate(([0.0, LIMIT], values[values < LIMIT])))
    middle = 0.5 * (knots[1:] + knots[:-1])
    assert exact_auc(values) == pytest.approx((np.diff(knots) * recall_curve(values, middle)).sum() / LIMIT, abs=1e-12)
    expected = twin.vocap(values)
    assert vocap_auc(values) == pytest.approx(0.0 if math.isnan(expected) else expected, abs=1e-12)
    assert exact_auc(values) - 1e-12 <= vocap_auc(values) <= exact_auc(values) + 1.0 / len(values) + 1e-12


def test_recall_counts_errors_below_the_threshold():
    errors = np.array([0.01, 0.02, np.inf])
    assert recall_curve(errors, np.array([0.0, 0.01, 0.015, 0.1])) == pytest.approx([0.0, 0.0, 1 / 3, 2 / 3])
    assert np.isnan(recall_curve(np.empty(0), np.array([0.1]))).all()


def test_bands_include_their_lower_limit_and_the_last_its_upper_one():
    index = band_indices(np.array([0.0, 0.09, 0.1, 1.0, 1.1, -0.1, np.nan]), (0.0, 0.1, 1.0))
    assert index.tolist() == [0, 0, 1, 1, -1, -1, -1]
    low, high = error_bands(np.array([0.05, np.inf, 0.01]), np.array([0.0, 0.5, 0.6]), (0.0, 0.1, 1.0))
    assert (low.count, low.auc, low.recall, low.median) == pytest.approx((1, 0.5, 1.0, 0.05))
    assert (high.count, high.auc, high.recall, high.median) == pytest.approx((2, 0.45, 0.5, 0.01))
    assert math.isnan(error_bands(np.empty(0), np.empty(0), (0.0, 1.0))[0].auc)
