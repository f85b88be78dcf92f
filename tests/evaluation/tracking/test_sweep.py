"""Sweep of the filter's weight: scores per mode and alpha, the optimum where theory has it, refused input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.apps.evaluation import PoseTable, filter_poses, split_by_mode, sweep_alpha
from synpick_warp.apps.evaluation.tracking.sweep import SWEEP_ALPHAS, AlphaSweep
from synpick_warp.errors import ConfigError, DatasetError
from tests.harness.fuzz import fuzz_examples
from tests.worlds.noisy_tracks import FRAME, Motion, estimates, true_poses


def accuracy(truth: PoseTable):
    """Score function: minus the mean squared position error [m²], after the first 100 images."""
    return lambda table: -float(np.mean((table.translation - truth.translation)[truth.image >= 100] ** 2))


def test_at_rest_the_smallest_alpha_is_best_and_in_motion_the_one_of_least_noise_and_lag():
    noise, velocity = 0.01, 0.02
    rest = true_poses(*(Motion(scene=scene, images=300) for scene in range(20)))
    moving = true_poses(*(Motion(scene=scene, images=300, velocity=(velocity,) * 3) for scene in range(20)))
    tables = {"pick": estimates(rest, noise=noise), "move": estimates(moving, noise=noise)}
    alphas = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0])
    sweep = sweep_alpha(tables, {"pick": accuracy(rest), "move": accuracy(moving)}, alphas.tolist())
    expected = noise**2 * alphas / (2 - alphas) + (velocity * FRAME * (1 - alphas) / alphas) ** 2
    np.testing.assert_allclose(-sweep.scores[1], expected, rtol=0.1)
    assert sweep.best("pick")[0] == 0.02
    assert sweep.best("move")[0] == alphas[np.argmin(expected)] == 0.3
    np.testing.assert_allclose(sweep.scores[:, -1], sweep.unfiltered)


def test_rows_of_the_table_name_the_optimum_and_the_gain():
    table = true_poses(Motion(velocity=(1.0, 0, 0)))
    sweep = sweep_alpha({"move": table}, lambda one: float(one.translation[-1, 0]), [0.5, 0.05, 0.5])
    assert sweep.alphas == (0.05, 0.5)
    rows = sweep.rows()
    assert [(row["mode"], row["alpha"], row["best"]) for row in rows] == [("move", 0.05, False), ("move", 0.5, True)]
    assert all(row["gain"] == pytest.approx(row["score"] - table.translation[-1, 0]) for row in rows)


def test_among_equal_scores_the_largest_alpha_is_best():
    sweep = sweep_alpha({"pick": true_poses(Motion())}, lambda table: 1.0)
    assert sweep.alphas == SWEEP_ALPHAS
    assert sweep.best("pick") == (1.0, 1.0)


def test_estimates_are_split_by_the_mode_of_their_scenes():
    table = true_poses(*(Motion(scene=scene, images=3) for scene in (4, 5, 6)))
    parts = split_by_mode(table, {6: "pick", 5: "move", 4: "pick", 9: "target"})
    assert list(parts) == ["pick", "move", "target"]
    assert [np.unique(part.scene).tolist() for part in parts.values()] == [[4, 6], [5], []]
    with pytest.raises(DatasetError, match=r"^scene 6 has no mode"):
        split_by_mode(table, {4: "pick", 5: "move"})


def test_a_mode_without_estimates_is_scored_too():
    empty = true_poses(Motion()).select(np.arange(0))
    assert sweep_alpha({"move": empty}, len).scores.tolist() == [[0.0] * len(SWEEP_ALPHAS)]


def test_what_cannot_be_swept_is_refused():
    tables = {"pick": true_poses(Motion())}
    with pytest.raises(ConfigError, match="at least one mode and one alpha"):
        sweep_alpha(tables, len, [])
    with pytest.raises(ConfigError, match="at least one mode and one alpha"):
        sweep_alpha({}, len)
    with pytest.raises(ConfigError, match=r"alpha 1\.5 is not allowed"):
        sweep_alpha(tables, len, [0.1, 1.5])
    with pytest.raises(ConfigError, match="mode pick has no score function"):
        sweep_alpha(tables, {"move": len})
    with pytest.raises(DatasetError, match=r"score of mode pick with no filter is nan"):
        sweep_alpha(tables, lambda table: float("nan"))


@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=6), st.integers(0, 2**31))
@settings(max_examples=fuzz_examples(50), deadline=None)
def test_fuzz_the_sweep_scores_what_the_filter_returns(alphas, seed):
    truth = true_poses(Motion(images=8), Motion(images=8, start=(0.3, 0, 1)))
    table = estimates(truth, seed, noise=0.05, angle=0.2, missing=0.1)
    sweep: AlphaSweep = sweep_alpha({"move": table}, lambda one: float(one.translation.sum()), alphas)
    assert sweep.alphas == tuple(sorted(set(alphas)))
    for alpha, score in zip(sweep.alphas, sweep.scores[0], strict=True):
        assert score == pytest.approx(filter_poses(table, alpha).translation.sum())
    assert sweep.best("move")[1] == sweep.scores.max()
