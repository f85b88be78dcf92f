"""Pose errors: hand-computed values, agreement with the BOP toolkit's functions, invariance under symmetries;
their AUC against numerical integration and PoseCNN's code."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.auc import LIMIT, band_indices, error_bands, exact_auc, recall_curve, vocap_auc
from synpick_warp.apps.evaluation.errors import VertexSearch, add_errors, adds_errors, rotation_errors, translation_errors
from synpick_warp.apps.evaluation.models import expand_symmetries
from synpick_warp.scenes.assets.models_info import FileModelInfo
from tests.harness.fuzz import fuzz_examples
from tests.twins import pose_errors as twin

AXIS = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def random_pairs(seed: int, count: int, spread: float = 0.1) -> tuple[np.ndarray, ...]:
    """Estimated and true rotations and translations [m]."""
    random = np.random.default_rng(seed)
    true = Rotation.random(count, rng=random)
    estimated = true * Rotation.from_rotvec(random.normal(0.0, random.choice([1e-3, 0.1, 2.0], (count, 1)), (count, 3)))
    place = random.uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.5), (count, 3))
    return estimated.as_matrix(), place + random.normal(0.0, spread, (count, 3)), true.as_matrix(), place


def test_hand_computed_errors():
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    quarter = Rotation.from_euler("z", [[90]], degrees=True).as_matrix()
    one, zero = np.eye(3)[None], np.zeros((1, 3))
    # Quarter turn: one vertex stays, the other moves by √2; its nearest vertex in the estimated pose is the origin.
    assert add_errors(quarter, zero, one, zero, vertices) == pytest.approx([np.sqrt(2.0) / 2.0])
    assert adds_errors(quarter, zero, one, zero, vertices) == pytest.approx([0.5])
    assert add_errors(one, np.array([[3.0, 4.0, 0.0]]), one, zero, vertices) == pytest.approx([5.0])
    assert adds_errors(one, np.array([[1.0, 0.0, 0.0]]), one, zero, vertices) == pytest.approx([0.5])
    assert translation_errors(np.array([[3.0, 4.0, 0.0]]), zero) == pytest.approx([5.0])
    assert rotation_errors(quarter, one) == pytest.approx([90.0])


def test_adds_searches_from_the_true_to_the_estimated_pose():
    vertices = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [5.0, 0.0, 0.0]])
    turned = Rotation.from_euler("y", [[90]], degrees=True).as_matrix()
    pair = turned, np.array([[0.0, 0.0, 1.0]]), np.eye(3)[None], np.zeros((1, 3))
    forward, backward = adds_errors(*pair, vertices), adds_errors(*pair[2:], *pair[:2], vertices)
    assert abs(forward - backward) > 0.01
    assert forward == pytest.approx([twin.adi(*(part[0] for part in pair), vertices)])


@pytest.mark.parametrize("size", [4, 300])
def test_errors_agree_with_the_toolkit(size):
    vertices = np.random.default_rng(size).normal(0.0, 0.05, (size, 3))
    pairs = random_pairs(size, fuzz_examples(200))
    search = VertexSearch(vertices)
    rows = list(zip(*pairs, strict=True))
    assert add_errors(*pairs, vertices) == pytest.approx([twin.add(*row, vertices) for row in rows], abs=1e-6)
    assert adds_errors(*pairs, vertices, search) == pytest.approx([twin.adi(*row, vertices) for row in rows], abs=1e-6)
    assert translation_errors(pairs[1], pairs[3]) == pytest.approx([twin.te(row[1], row[3]) for row in rows], abs=1e-6)
    # The toolkit's arccos has half of the digits near 0.
    assert rotation_errors(pairs[0], pairs[2]) == pytest.approx([twin.re(row[0], row[2]) for row in rows], abs=2e-6)


def test_errors_of_many_pairs_are_those_of_each_pair(monkeypatch):
    vertices = np.random.default_rng(1).normal(0.0, 0.05, (7, 3))
    pairs = random_pairs(2, 23)
    whole = add_errors(*pairs, vertices), adds_errors(*pairs, vertices)
    for name in ("_CHUNK", "_QUERIED"):
        monkeypatch.setattr(f"synpick_warp.apps.evaluation.errors.{name}", 20)
    for function, expected in zip((add_errors, adds_errors), whole, strict=True):
        np.testing.assert_allclose(function(*pairs, vertices), expected, rtol=1e-12, atol=1e-15)


@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 30))
@settings(max_examples=fuzz_examples(100))
def test_errors_obey_their_bounds(seed, size):
    """ADD-S is at most ADD; ADD is at least the centroid's way; a rigid motion of both poses changes nothing; equal poses have none."""
    vertices = np.random.default_rng(seed).normal(0.0, 0.05, (size, 3))
    pairs = random_pairs(seed, 5)
    add, adds = add_errors(*pairs, vertices), adds_errors(*pairs, vertices)
    assert (adds <= add + 1e-12).all()
    offset = (pairs[0] - pairs[2]) @ vertices.mean(axis=0) + pairs[1] - pairs[3]
    assert (add >= np.linalg.norm(offset, axis=1) - 1e-12).all()
    motion = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    elsewhere = motion @ pairs[0], pairs[1] @ motion.T + 1.0, motion @ pairs[2], pairs[3] @ motion.T + 1.0
    np.testing.assert_allclose(add_errors(*elsewhere, vertices), add, atol=1e-12)
    np.testing.assert_allclose(adds_errors(*elsewhere, vertices), adds, atol=1e-12)
    assert np.abs(adds_errors(*pairs[2:], *pairs[2:], vertices)).max() < 1e-12
    assert rotation_errors(pairs[2], pairs[2]).max() < 1e-10


@given(seed=st.integers(0, 2**32 - 1), sides=st.integers(2, 12), step=st.integers(0, 11))
@settings(max_examples=fuzz_examples(100))
def test_symmetric_objects_are_invariant_under_their_symmetries(seed, sides, step):
    random = np.random.default_rng(seed)
    turns = [Rotation.from_euler("z", 360.0 * k / sides, degrees=True).as_matrix() for k in range(sides)]
    wedge = random.normal(0.0, 0.05, (4, 3))
    vertices = np.concatenate([wedge @ turn.T for turn in turns])
    rotation, place, true_rotation, true_place = random_pairs(seed, 3)
    turn = turns[step % sides]
    np.testing.assert_allclose(
        adds_errors(rotation @ turn, place, true_rotation, true_place, vertices),
        adds_errors(rotation, place, true_rotation, true_place, vertices),
        atol=1e-12,
    )
    symmetries = np.stack(turns)
    error = rotation_errors(rotation, true_rotation, symmetries)
    np.testing.assert_allclose(rotation_errors(rotation @ turn, true_rotation, symmetries), error, atol=1e-6)
    assert (error <= rotation_errors(rotation, true_rotation) + 1e-9).all()
    assert rotation_errors(true_rotation @ turn, true_rotation, symmetries) == pytest.approx(0.0, abs=1e-6)


def test_continuous_symmetries_are_steps_about_the_axis():
    flip = (1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, 1.0)
    symmetries = expand_symmetries(FileModelInfo(0.1, (flip,), (AXIS,)))
    assert len(symmetries) == 2 * 315
    np.testing.assert_array_equal(symmetries[0], np.eye(3))
    true = Rotation.random(50, rng=np.random.default_rng(3)).as_matrix()
    turns = Rotation.from_euler("z", np.linspace(0.0, 360.0, 50)[:, None], degrees=True).as_matrix()
    assert rotation_errors(true @ turns, true, symmetries).max() < 180.0 / 315 + 1e-9
    assert len(expand_symmetries(FileModelInfo())) == 1


def test_rotation_errors_are_precise_at_both_ends():
    angles = np.array([0.0, 1e-7, 1e-3, 90.0, 179.999, 180.0])
    turns = Rotation.from_euler("x", angles[:, None], degrees=True).as_matrix()
    assert rotation_errors(turns, np.broadcast_to(np.eye(3), turns.shape)) == pytest.approx(angles, abs=1e-10)


# ---- area under the accuracy-threshold curve ----

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
