"""The paper's filter on analytic trajectories: noise at rest, lag in motion, the shorter arc, gaps, order of rows, refused input."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from synpick_warp.apps.evaluation import PAPER_ALPHAS, PoseTable, filter_poses
from synpick_warp.errors import ConfigError, DatasetError
from tests.harness.fuzz import fuzz_examples
from tests.worlds.noisy_tracks import FRAME, Motion, estimates, noisy_tables, true_poses

ALPHAS = (0.05, 0.2, 0.5, 0.9)


def with_poses(table: PoseTable, rotation: Rotation | None = None, translation: np.ndarray | None = None) -> PoseTable:
    changed = {} if rotation is None else {"rotation": rotation.as_matrix()}
    return dataclasses.replace(table, **changed, **({} if translation is None else {"translation": translation}))


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


def test_the_first_three_positions_by_hand():
    table = with_poses(true_poses(Motion(images=3)), translation=np.array([[0.0, 0, 1], [1.0, 0, 1], [1.0, 2, 1]]))
    filtered = filter_poses(table, 0.25)
    np.testing.assert_allclose(filtered.translation, [[0, 0, 1], [0.25, 0, 1], [0.4375, 0.5, 1]], atol=1e-15)


def test_alpha_is_the_papers_and_weighs_the_new_estimate():
    assert PAPER_ALPHAS == (0.05, 0.2)
    table = with_poses(true_poses(Motion(images=2)), translation=np.array([[0.0, 0, 1], [1.0, 0, 1]]))
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
def test_at_constant_velocity_the_position_lags_by_v_dt_one_minus_alpha_over_alpha(alpha):
    velocity = np.array([0.1, -0.05, 0.2])
    truth = true_poses(Motion(velocity=tuple(velocity), images=600))
    lag = truth.translation - filter_poses(truth, alpha).translation
    np.testing.assert_allclose(lag[-1], velocity * FRAME * (1 - alpha) / alpha, rtol=1e-9)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_at_constant_rate_the_rotation_lags_by_w_dt_one_minus_alpha_over_alpha(alpha):
    # 0.4 rad/s: at alpha 0.05 a lag of 0.51 rad, below half a turn, beyond which the shorter arc would change its side.
    spin = np.array([0.0, 0.24, 0.32])
    truth = true_poses(Motion(spin=tuple(spin), images=900))
    lag = Rotation.from_matrix(truth.rotation) * Rotation.from_matrix(filter_poses(truth, alpha).rotation).inv()
    np.testing.assert_allclose(lag[-1].as_rotvec(), spin * FRAME * (1 - alpha) / alpha, rtol=1e-6, atol=1e-12)


def test_rotations_take_the_shorter_arc():
    turns = Rotation.from_euler("z", [[10.0], [-10.0]], degrees=True), Rotation.from_euler("z", [[170.0], [-170.0]], degrees=True)
    halves = [filter_poses(with_poses(true_poses(Motion(images=2)), turn), 0.5).rotation[1] for turn in turns]
    np.testing.assert_allclose(halves, Rotation.from_euler("z", [[0.0], [180.0]], degrees=True).as_matrix(), atol=1e-12)


def test_the_sign_of_a_quaternion_does_not_matter():
    quaternion = Rotation.from_rotvec(np.outer(np.arange(30), [0.02, -0.05, 0.1])).as_quat()
    signs = np.where(np.arange(30) % 2, -1.0, 1.0)[:, None]
    truth = true_poses(Motion(images=30))
    plain, flipped = (filter_poses(with_poses(truth, Rotation.from_quat(one)), 0.2) for one in (quaternion, signs * quaternion))
    np.testing.assert_allclose(plain.rotation, flipped.rotation, atol=1e-14)


def test_half_a_turn_ends_halfway_on_either_arc():
    turn = Rotation.from_euler("z", [[0.0], [180.0]], degrees=True)
    table = with_poses(true_poses(Motion(images=2)), turn)
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
    table = estimates(true_poses(Motion(spin=(1, 2, 3)), Motion(object_id=4)), noise=0.1, angle=1.0, missing=0.1)
    filtered = filter_poses(table, 1.0)
    np.testing.assert_array_equal(filtered.translation, table.translation)
    np.testing.assert_allclose(filtered.rotation, table.rotation, atol=1e-12)
    for name in ("scene", "image", "object_id", "score", "seconds", "instance"):
        np.testing.assert_array_equal(getattr(filter_poses(table, 0.05), name), getattr(table, name))


def test_a_table_without_rows_stays_empty():
    assert len(filter_poses(true_poses(Motion()).select(np.zeros(100, bool)))) == 0


def test_the_input_is_not_written_to():
    table = estimates(true_poses(Motion()), noise=0.01, angle=0.1)
    for name in ("translation", "rotation"):
        getattr(table, name).setflags(write=False)
    filter_poses(table, symmetries={17: np.eye(4)[None]})


def test_jumps_between_equivalent_poses_pull_the_filter_unless_symmetries_are_given():
    half_turn = np.eye(4)
    half_turn[:3, :3] = np.diag([-1.0, -1.0, 1.0])
    half_turn[:3, 3] = [0.02, 0.0, 0.0]
    truth = true_poses(Motion(images=60))
    odd = truth.image % 3 == 2
    rotation = np.where(odd[:, None, None], truth.rotation @ half_turn[:3, :3], truth.rotation)
    translation = truth.translation + odd[:, None] * (truth.rotation @ half_turn[:3, 3])
    table = dataclasses.replace(truth, rotation=rotation, translation=translation)
    filtered = filter_poses(table, 0.2, symmetries={17: np.stack((np.eye(4), half_turn))})
    assert angles(filtered, truth).max() < 1e-7
    np.testing.assert_allclose(filtered.translation, truth.translation, atol=1e-12)
    assert angles(filter_poses(table, 0.2), truth).max() > 0.5
    other = filter_poses(table, 0.2, symmetries={3: np.stack((np.eye(4), half_turn))})
    np.testing.assert_array_equal(other.rotation, filter_poses(table, 0.2).rotation)


@pytest.mark.parametrize("alpha", [0.0, -0.1, 1.0001, float("nan"), float("inf")])
def test_an_alpha_out_of_range_is_refused(alpha):
    with pytest.raises(ConfigError, match=r"^alpha .* is not allowed: .* above 0 and at most 1"):
        filter_poses(true_poses(Motion()), alpha)


@pytest.mark.parametrize(("name", "value"), [("translation", np.nan), ("rotation", np.inf), ("translation", 1e300), ("rotation", 7.0)])
def test_a_pose_that_is_none_is_refused_with_its_place(name, value):
    table = true_poses(Motion())
    getattr(table, name)[42] = value
    with pytest.raises(DatasetError, match=r"^the pose of scene 1, image 42, object 17 is not finite"):
        filter_poses(table)


def test_a_left_handed_or_singular_rotation_is_refused():
    table = true_poses(Motion())
    table.rotation[3] = np.diag([1.0, 1.0, -1.0])
    with pytest.raises(DatasetError, match=r"^matrix 3 of the estimates is no rotation"):
        filter_poses(table)
    with pytest.raises(DatasetError, match=r"^matrix 1 of the symmetries of object 5 is no rotation"):
        filter_poses(true_poses(Motion()), symmetries={5: np.stack((np.eye(4), np.diag([1.0, 0.0, 0.0, 1.0])))})


def test_tracks_that_do_not_fit_are_refused():
    table = true_poses(Motion(images=3), Motion(object_id=2, images=3))
    with pytest.raises(DatasetError, match="give one track index a row"):
        filter_poses(table, tracks=np.zeros(2, int))
    with pytest.raises(DatasetError, match="track 0 mixes scenes or objects"):
        filter_poses(table, tracks=np.zeros(6, int))
    with pytest.raises(DatasetError, match="shape"):
        filter_poses(dataclasses.replace(table, image=table.image[:2]))
    with pytest.raises(DatasetError, match="symmetries of object 2 have shape"):
        filter_poses(table, symmetries={2: np.eye(4)})


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


@given(st.lists(st.integers(0, 3), min_size=2, max_size=20), st.floats(0.3, 1.0), st.integers(0, 2**31))
@settings(max_examples=fuzz_examples(50), deadline=None)
def test_fuzz_with_symmetries_it_does_not_matter_which_equivalent_pose_came(choices, alpha, seed):
    # Quarter turns about an axis beside the model's origin; motion and noise stay far below the 45° where two are as near.
    quarter = np.eye(4)
    quarter[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    quarter[:3, 3] = [0.03, -0.01, 0]
    group = np.stack([np.linalg.matrix_power(quarter, power) for power in range(4)])
    table = estimates(true_poses(Motion(spin=(0.2, 0.3, -0.4), images=len(choices))), seed, noise=0.01, angle=0.03)
    chosen = group[[0, *choices[1:]]]
    translation = table.translation + np.einsum("nij,nj->ni", table.rotation, chosen[:, :3, 3])
    jumping = dataclasses.replace(table, rotation=table.rotation @ chosen[:, :3, :3], translation=translation)
    smooth, filtered = filter_poses(table, alpha), filter_poses(jumping, alpha, symmetries={17: group})
    np.testing.assert_allclose(filtered.translation, smooth.translation, atol=1e-9)
    np.testing.assert_allclose(filtered.rotation, smooth.rotation, atol=1e-9)
