"""Association of estimates to tracks: the paper's single instances, several instances, gates, gaps, never across scenes or objects."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation import PoseTable, find_tracks, track_of_instance
from synpick_warp.errors import ConfigError, DatasetError
from tests.harness.fuzz import fuzz_examples
from tests.worlds.noisy_tracks import Motion, estimates, noisy_tables, true_poses


def purity(tracks: np.ndarray, truth: np.ndarray) -> float:
    """Fraction of rows whose true instance is their track's most frequent one."""
    return sum(np.bincount(truth[tracks == track]).max() for track in np.unique(tracks)) / len(tracks)


def test_a_single_instance_is_one_track_whatever_its_jumps_and_gaps():
    table = estimates(true_poses(Motion(velocity=(0.5, 0, 0))), noise=0.05, outliers=0.3, jump=2.0, missing=0.5)
    assert (find_tracks(table) == 0).all()


def test_tracks_are_sorted_by_scene_object_and_first_image():
    table = true_poses(
        Motion(scene=2), Motion(scene=1, object_id=5), Motion(scene=1, object_id=3), Motion(scene=1, object_id=3, start=(1, 0, 1))
    )
    tracks = find_tracks(table)
    keys = [(int(table.scene[tracks == one][0]), int(table.object_id[tracks == one][0])) for one in range(4)]
    assert keys == [(1, 3), (1, 3), (1, 5), (2, 17)]
    assert np.bincount(tracks).tolist() == [100] * 4


def test_instances_of_an_object_that_pass_each_other_stay_apart():
    truth = true_poses(Motion(start=(-0.2, 0.0, 2), velocity=(0.06, 0, 0)), Motion(start=(0.2, 0.1, 2), velocity=(-0.06, 0, 0), instance=1))
    hidden = dataclasses.replace(truth, instance=np.full(len(truth), -1))
    assert purity(find_tracks(hidden), truth.instance) == 1.0


def test_an_outlier_next_to_another_instance_does_not_swap_tracks():
    truth = true_poses(Motion(start=(0, 0, 2)), Motion(start=(0.1, 0, 2), instance=1))
    hidden = dataclasses.replace(truth, instance=np.full(len(truth), -1), translation=truth.translation.copy())
    hidden.translation[(truth.image == 50) & (truth.instance == 0)] = [0.5, 0, 2]
    assert purity(find_tracks(hidden), truth.instance) == 1.0


def test_the_choice_of_axes_does_not_matter_among_crowded_instances():
    crowd = true_poses(*(Motion(start=(0.05 * instance, 0, 2), instance=instance, images=60) for instance in range(4)))
    table = estimates(crowd, noise=0.05)
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1])
    turned = dataclasses.replace(table, translation=turn.apply(table.translation))
    np.testing.assert_array_equal(find_tracks(turned), find_tracks(table))


def test_the_instance_that_stays_keeps_its_track_when_the_other_is_picked():
    truth = true_poses(Motion(start=(0, 0, 2), images=30), Motion(start=(0.2, 0, 2), instance=1))
    hidden = dataclasses.replace(truth, instance=np.full(len(truth), -1))
    assert purity(find_tracks(hidden), truth.instance) == 1.0


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


def test_beyond_the_gate_a_new_track_begins_and_the_old_one_waits():
    table = true_poses(Motion(images=10))
    table.translation[4] += [0.5, 0, 0]
    assert find_tracks(table, gate=0.1).tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0, 0]


def test_a_gap_beyond_the_largest_begins_a_new_track():
    table = true_poses(Motion(images=20))
    kept = table.select((table.image < 5) | (table.image > 8))
    assert np.unique(find_tracks(kept, max_gap=5)).tolist() == [0]
    for gate in (None, 1.0):
        tracks = find_tracks(kept, gate=gate, max_gap=3)
        assert tracks.tolist() == (kept.image > 8).astype(int).tolist()


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
    with pytest.raises(DatasetError, match="of several instances"):
        track_of_instance(truth, table, tracks)


def test_settings_out_of_range_are_refused():
    table = true_poses(Motion())
    for gate in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match=r"^gate .* is not allowed"):
            find_tracks(table, gate=gate)
    with pytest.raises(ConfigError, match=r"^max_gap 0 is not allowed"):
        find_tracks(table, max_gap=0)
    with pytest.raises(DatasetError, match=r"^column score of the poses has shape \(3,\) instead of \(100,\)"):
        find_tracks(dataclasses.replace(table, score=np.ones(3)))


def test_a_table_without_rows_has_no_tracks():
    assert find_tracks(true_poses(Motion()).select(np.arange(0))).shape == (0,)


def check_tracks(table: PoseTable, tracks: np.ndarray) -> None:
    assert sorted(np.unique(tracks)) == list(range(len(np.unique(tracks))))
    for track in np.unique(tracks):
        rows = tracks == track
        for name in ("scene", "object_id", "instance"):
            assert len(np.unique(getattr(table, name)[rows])) == 1
        assert len(np.unique(table.image[rows])) == rows.sum()


@given(noisy_tables())
@settings(max_examples=fuzz_examples(100), deadline=None)
def test_fuzz_tracks_never_mix_scenes_objects_or_instances_nor_hold_two_rows_of_an_image(table):
    for gate, max_gap in ((None, None), (0.1, None), (None, 2), (0.05, 1)):
        check_tracks(table, find_tracks(table, gate, max_gap))


@given(noisy_tables())
@settings(max_examples=fuzz_examples(100), deadline=None)
def test_fuzz_without_gate_a_group_has_as_many_tracks_as_its_fullest_image(table):
    tracks = find_tracks(table)
    key = np.stack((table.scene, table.object_id, table.instance), axis=1)
    for group in np.unique(key, axis=0):
        rows = (key == group).all(axis=1)
        assert len(np.unique(tracks[rows])) == np.bincount(table.image[rows]).max()


@given(noisy_tables())
@settings(max_examples=fuzz_examples(50), deadline=None)
def test_fuzz_a_gate_wider_than_the_scene_is_no_gate(table):
    np.testing.assert_array_equal(find_tracks(table, gate=1e3), find_tracks(table))
