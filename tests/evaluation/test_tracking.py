"""Tracking over time: association of estimates, the paper's filter on analytic trajectories, and the sweep of its weight."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from synpick_warp.apps.evaluation import tracking
from synpick_warp.apps.evaluation.tracking import filter_poses, find_tracks, sweep_alpha, track_of_instance
from synpick_warp.apps.evaluation.truth import PoseTable
from synpick_warp.errors import ConfigError, DatasetError
from tests.harness.fuzz import fuzz_examples
from tests.worlds.noisy_tracks import FRAME, Motion, estimates, noisy_tables, true_poses

ALPHAS = (0.05, 0.2, 0.5, 0.9)


# ---- tracks ----


def purity(tracks: np.ndarray, truth: np.ndarray) -> float:
    """Fraction of rows whose true instance is their track's most frequent one."""
    return sum(np.bincount(truth[tracks == track]).max() for track in np.unique(tracks)) / len(tracks)


def test_a_single_instance_is_one_track_whatever_its_jumps_and_gaps():
    table = estimates(true_poses(Motion(velocity=(0.5, 0, 0))), noise=0.05, outliers=0.3, jump=2.0, missing=0.5)
    assert (find_tracks(table) == 0).all()


def test_tracks_are_sorted_by_scene_object_and_first_image():
    third = Motion(scene=1, object_id=3)
    table = true_poses(Motion(scene=2), Motion(scene=1, object_id=5), third, dataclasses.replace(third, start=(1, 0, 1)))
    tracks = find_tracks(table)
    keys = [(int(table.scene[tracks == one][0]), int(table.object_id[tracks == one][0])) for one in range(4)]
    assert keys == [(1, 3), (1, 3), (1, 5), (2, 17)]
    assert np.bincount(tracks).tolist() == [100] * 4


@pytest.mark.parametrize(
    ("first", "second", "outlier"),
    [
        (Motion(start=(-0.2, 0.0, 2), velocity=(0.06, 0, 0)), Motion(start=(0.2, 0.1, 2), velocity=(-0.06, 0, 0), instance=1), None),
        (Motion(start=(0, 0, 2)), Motion(start=(0.1, 0, 2), instance=1), [0.5, 0, 2]),
        (Motion(start=(0, 0, 2), images=30), Motion(start=(0.2, 0, 2), instance=1), None),
    ],
    ids=["they pass each other", "an outlier of one next to the other", "one is picked"],
)
def test_instances_of_an_object_keep_their_tracks(first, second, outlier):
    truth = true_poses(first, second)
    hidden = dataclasses.replace(truth, instance=np.full(len(truth), -1), translation=truth.translation.copy())
    if outlier:
        hidden.translation[(truth.image == 50) & (truth.instance == 0)] = outlier
    assert purity(find_tracks(hidden), truth.instance) == 1.0


def test_the_choice_of_axes_does_not_matter_among_crowded_instances():
    crowd = true_poses(*(Motion(start=(0.05 * instance, 0, 2), instance=instance, images=60) for instance in range(4)))
    table = estimates(crowd, noise=0.05)
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1])
    turned = dataclasses.replace(table, translation=turn.apply(table.translation))
    np.testing.assert_array_equal(find_tracks(turned), find_tracks(table))


def test_known_instances_are_tracks_though_they_change_places():
    truth = true_poses(Motion(start=(0, 0, 2)), Motion(start=(0.2, 0, 2), instance=1))
    swapped = dataclasses.replace(truth, translation=np.where((truth.image % 2 == 0)[:, None], truth.translation, 2.0 - truth.translation))
    np.testing.assert_array_equal(find_tracks(swapped), truth.instance)


def test_two_estimates_of_an_image_are_never_one_track_even_if_equal():
    once = true_poses(Motion(images=5))
    twice = once.select(np.repeat(np.arange(5), 2))
    for known in (0, -1):
        tracks = find_tracks(dataclasses.replace(twice, instance=np.full(10, known)))
        assert sorted(tracks[:2]) == [0, 1]
        assert np.bincount(tracks).tolist() == [5, 5]


def test_the_track_of_a_true_instance_is_the_one_most_often_nearest():
    truth = true_poses(Motion(start=(0, 0, 2)), Motion(start=(0.2, 0, 2), instance=1), Motion(scene=2), Motion(object_id=3))
    table = estimates(truth, noise=0.02, outliers=0.1, missing=0.2)
    tracks = find_tracks(table)
    for instance in range(2):
        one = truth.select((truth.scene == 1) & (truth.object_id == 17) & (truth.instance == instance))
        rows = track_of_instance(one, table, tracks)
        assert (table.scene[rows] == 1).all()
        assert (table.object_id[rows] == 17).all()
        assert (np.diff(table.image[rows]) > 0).all()
        np.testing.assert_allclose(np.median(table.translation[rows], axis=0), one.translation[0], atol=0.01)
        shuffled = np.random.default_rng(0).permutation(len(table))
        np.testing.assert_array_equal(shuffled[track_of_instance(one, table.select(shuffled), tracks[shuffled])], rows)
    gone = dataclasses.replace(one, object_id=one.object_id + 100)
    assert len(track_of_instance(gone, table, tracks)) == 0


@given(noisy_tables())
@settings(max_examples=fuzz_examples(100), deadline=None)
def test_fuzz_tracks_never_mix_scenes_objects_or_instances_nor_hold_two_rows_of_an_image(table):
    """A group has as many tracks as its fullest image."""
    tracks = find_tracks(table)
    assert sorted(np.unique(tracks)) == list(range(len(np.unique(tracks))))
    key = np.stack((table.scene, table.object_id, table.instance), axis=1)
    for track in np.unique(tracks):
        rows = tracks == track
        assert len(np.unique(key[rows], axis=0)) == 1
        assert len(np.unique(table.image[rows])) == rows.sum()
    for group in np.unique(key, axis=0):
        rows = (key == group).all(axis=1)
        assert len(np.unique(tracks[rows])) == np.bincount(table.image[rows]).max()


# ---- filter ----


def with_rotations(table: PoseTable, rotation: Rotation) -> PoseTable:
    return dataclasses.replace(table, rotation=rotation.as_matrix())


def angles(first: PoseTable, second: PoseTable) -> np.ndarray:
    """Angle between the rotations of two tables, row by row [rad]."""
    return (Rotation.from_matrix(first.rotation).inv() * Rotation.from_matrix(second.rotation)).magnitude()


def by_hand(table: PoseTable, alpha: float) -> tuple[np.ndarray, Rotation]:
    """The paper's formulas as they stand, with SciPy's slerp, on the rows of one track."""
    turns = Rotation.from_matrix(table.rotation)
    mean, turn = [table.translation[0]], [turns[0]]
    for row in range(1, len(table)):
        mean.append((1 - alpha) * mean[-1] + alpha * table.translation[row])
        turn.append(Slerp([0.0, 1.0], Rotation.concatenate([turn[-1], turns[row]]))(alpha))
    return np.array(mean), Rotation.concatenate(turn)


def test_alpha_is_the_papers_and_weighs_the_new_estimate():
    assert tracking.PAPER_ALPHAS == (0.05, 0.2)
    table = dataclasses.replace(true_poses(Motion(images=2)), translation=np.array([[0.0, 0, 1], [1.0, 0, 1]]))
    assert filter_poses(table).translation[1, 0] == pytest.approx(0.05)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_the_filter_is_the_recursion_of_the_paper(alpha):
    table = estimates(true_poses(Motion(velocity=(0.1, 0, -0.2), spin=(0, 0.3, 0.9))), noise=0.01, angle=0.2, outliers=0.1, missing=0.2)
    mean, turn = by_hand(table, alpha)
    filtered = filter_poses(table, alpha)
    np.testing.assert_allclose(filtered.translation, mean, atol=1e-13)
    np.testing.assert_allclose(filtered.rotation, turn.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_at_rest_the_variance_falls_by_alpha_over_two_minus_alpha(alpha):
    noise, angle = 0.01, 0.01
    truth = true_poses(*(Motion(scene=scene, images=400) for scene in range(40)))
    filtered = filter_poses(estimates(truth, noise=noise, angle=angle), alpha)
    settled = truth.image >= 200
    factor = alpha / (2 - alpha)
    # 8,000 frames of 40 tracks: at alpha 0.05 some 400 independent samples of 3 coordinates, a standard error of 4 %.
    assert np.var((filtered.translation - truth.translation)[settled]) == pytest.approx(factor * noise**2, rel=0.15)
    assert np.mean(angles(filtered, truth)[settled] ** 2) == pytest.approx(3 * factor * angle**2, rel=0.15)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_at_constant_velocity_and_rate_poses_lag_by_v_dt_one_minus_alpha_over_alpha(alpha):
    # 0.4 rad/s: at alpha 0.05 a lag of 0.51 rad, below half a turn, beyond which the shorter arc would change its side.
    velocity, spin, frames = np.array([0.1, -0.05, 0.2]), np.array([0.0, 0.24, 0.32]), FRAME * (1 - alpha) / alpha
    truth = true_poses(Motion(velocity=tuple(velocity), spin=tuple(spin), images=900))
    filtered = filter_poses(truth, alpha)
    np.testing.assert_allclose((truth.translation - filtered.translation)[-1], velocity * frames, rtol=1e-9)
    turn = Rotation.from_matrix(truth.rotation) * Rotation.from_matrix(filtered.rotation).inv()
    np.testing.assert_allclose(turn[-1].as_rotvec(), spin * frames, rtol=1e-6, atol=1e-12)


def test_rotations_take_the_shorter_arc_and_half_a_turn_ends_halfway_on_either():
    two = true_poses(Motion(images=2))
    turns = (Rotation.from_euler("z", [[first], [-first]], degrees=True) for first in (10.0, 170.0))
    halves = [filter_poses(with_rotations(two, turn), 0.5).rotation[1] for turn in turns]
    np.testing.assert_allclose(halves, Rotation.from_euler("z", [[0.0], [180.0]], degrees=True).as_matrix(), atol=1e-12)
    table = with_rotations(two, Rotation.from_euler("z", [[0.0], [180.0]], degrees=True))
    assert np.degrees(angles(filter_poses(table, 0.5), table)) == pytest.approx([0.0, 90.0])


def test_a_gap_is_no_step_and_gets_no_rows():
    table = estimates(true_poses(Motion(images=20)), noise=0.02, angle=0.1)
    kept = table.select((table.image < 5) | (table.image >= 15))
    renumbered = dataclasses.replace(kept, image=np.arange(len(kept)))
    filtered = filter_poses(kept, 0.2)
    np.testing.assert_array_equal(filtered.image, kept.image)
    np.testing.assert_array_equal(filtered.translation, filter_poses(renumbered, 0.2).translation)
    np.testing.assert_allclose(filtered.translation[5], 0.8 * filtered.translation[4] + 0.2 * kept.translation[5])


def test_alpha_one_changes_nothing_and_all_else_stays():
    """The input is not written to, and a table without rows stays empty."""
    table = estimates(true_poses(Motion(spin=(1, 2, 3)), Motion(object_id=4)), noise=0.1, angle=1.0, missing=0.1)
    for name in ("translation", "rotation"):
        getattr(table, name).setflags(write=False)
    filtered = filter_poses(table, 1.0)
    np.testing.assert_array_equal(filtered.translation, table.translation)
    np.testing.assert_allclose(filtered.rotation, table.rotation, atol=1e-12)
    for name in ("scene", "image", "object_id", "score", "seconds", "instance"):
        np.testing.assert_array_equal(getattr(filter_poses(table, 0.05), name), getattr(table, name))
    empty = table.select(np.zeros(len(table), bool))
    assert len(filter_poses(empty)) == len(find_tracks(empty)) == 0


@pytest.mark.parametrize("alpha", [0.0, -0.1, 1.0001, float("nan"), float("inf")])
def test_an_alpha_out_of_range_is_refused(alpha):
    with pytest.raises(ConfigError, match=r"^alpha .* is not allowed: .* above 0 and at most 1"):
        filter_poses(true_poses(Motion()), alpha)


NOT_FINITE = r"^the pose of scene 1, image 42, object 17 is not finite"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("translation", np.nan, NOT_FINITE),
        ("rotation", np.inf, NOT_FINITE),
        ("translation", 1e300, NOT_FINITE),
        ("rotation", 7.0, NOT_FINITE),
        ("rotation", np.diag([1.0, 1.0, -1.0]), "^matrix 42 of the estimates is no rotation"),
    ],
)
def test_a_pose_that_is_none_is_refused_with_its_place(name, value, said):
    table = true_poses(Motion())
    getattr(table, name)[42] = value
    with pytest.raises(DatasetError, match=said):
        filter_poses(table)


@given(noisy_tables(), st.floats(0.01, 1.0), st.integers(0, 2**31))
@settings(max_examples=fuzz_examples(100), deadline=None)
def test_fuzz_the_order_of_rows_does_not_matter(table, alpha, seed):
    shuffled = np.random.default_rng(seed).permutation(len(table))
    straight, mixed = filter_poses(table, alpha), filter_poses(table.select(shuffled), alpha)
    np.testing.assert_array_equal(mixed.image, table.image[shuffled])
    np.testing.assert_allclose(mixed.translation, straight.translation[shuffled], atol=1e-12)
    np.testing.assert_allclose(mixed.rotation, straight.rotation[shuffled], atol=1e-9)


@given(noisy_tables(), st.floats(0.01, 1.0))
@settings(max_examples=fuzz_examples(50), deadline=None)
def test_fuzz_scenes_and_objects_are_filtered_as_if_alone(table, alpha):
    filtered = filter_poses(table, alpha)
    for scene, object_id in {(int(a), int(b)) for a, b in zip(table.scene, table.object_id, strict=True)}:
        rows = (table.scene == scene) & (table.object_id == object_id)
        alone = filter_poses(table.select(rows), alpha)
        np.testing.assert_allclose(filtered.translation[rows], alone.translation, atol=1e-12)
        np.testing.assert_allclose(filtered.rotation[rows], alone.rotation, atol=1e-9)


@given(noisy_tables(), st.floats(0.01, 1.0), st.integers(0, 2**31))
@settings(max_examples=fuzz_examples(50), deadline=None)
def test_fuzz_a_rigid_change_of_the_camera_frame_commutes_with_the_filter(table, alpha, seed):
    # Equivariance: positions are averaged linearly, rotations by the angle between them, whatever the axes.
    turn, shift = Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), np.array([0.3, -0.1, 0.7])
    moved = dataclasses.replace(table, rotation=turn @ table.rotation, translation=table.translation @ turn.T + shift)
    straight, after = filter_poses(table, alpha), filter_poses(moved, alpha)
    np.testing.assert_allclose(after.translation, straight.translation @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(after.rotation, turn @ straight.rotation, atol=1e-6)


# ---- sweep ----


def accuracy(truth: PoseTable, table: PoseTable) -> float:
    """Minus the mean squared position error [m²], after the first 100 images."""
    return -float(np.mean((table.translation - truth.translation)[truth.image >= 100] ** 2))


def test_at_rest_the_smallest_alpha_is_best_and_in_motion_the_one_of_least_noise_and_lag():
    noise, velocity = 0.01, 0.02
    rest = true_poses(*(Motion(scene=scene, images=300) for scene in range(20)))
    moving = true_poses(*(Motion(scene=scene, images=300, velocity=(velocity,) * 3) for scene in range(20)))
    tables = {"pick": estimates(rest, noise=noise), "move": estimates(moving, noise=noise)}
    alphas = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0])
    truths = {"pick": rest, "move": moving}
    sweep = sweep_alpha(tables, lambda mode, table: accuracy(truths[mode], table), alphas.tolist())
    expected = noise**2 * alphas / (2 - alphas) + (velocity * FRAME * (1 - alphas) / alphas) ** 2
    np.testing.assert_allclose(-sweep.scores[1], expected, rtol=0.1)
    assert sweep.best("pick")[0] == 0.02
    assert sweep.best("move")[0] == alphas[np.argmin(expected)] == 0.3
    np.testing.assert_allclose(sweep.scores[:, -1], sweep.unfiltered)


def test_sweeps_choose_the_largest_of_equal_weights_also_for_modes_without_estimates():
    table = true_poses(*(Motion(scene=scene, images=3) for scene in (4, 5, 6)))
    parts = tracking.split_by_mode(table, {6: "pick", 5: "move", 4: "pick", 9: "target"})
    assert list(parts) == ["pick", "move", "target"]
    assert [np.unique(part.scene).tolist() for part in parts.values()] == [[4, 6], [5], []]
    sweep = sweep_alpha(parts, lambda mode, table: len(table))
    assert sweep.alphas == tracking.SWEEP_ALPHAS
    assert sweep.best("pick") == (1.0, 6.0)
    assert sweep.scores.tolist() == [[count] * len(tracking.SWEEP_ALPHAS) for count in (6.0, 3.0, 0.0)]
