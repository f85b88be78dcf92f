"""Choice of the target instance, and of grasp points on it where the surface is flat."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import MAX_INSTANCES, Mode, Outcome, Phase, Stream
from synpick_warp.stages.arrays import count_words
from tests.twins import planning, rng
from tests.twins.planning import PlannerHarness, paint_shapes
from tests.worlds.kernel_worlds import cup_places, filled

SEED = 9


def harness_of(device, visible, fraction, ancestors) -> PlannerHarness:
    """One world and one view a row."""
    visible = np.atleast_2d(visible)
    harness = PlannerHarness.unseen(device, *visible.shape)
    harness.observation.visible.assign(visible)
    harness.observation.visible_fraction.assign(np.atleast_2d(fraction))
    harness.observation.ancestors.assign(np.reshape(ancestors, harness.observation.ancestors.shape).astype(np.uint32))
    harness.worlds.begin(Phase.ACT)
    harness.attempts.attempt.fill_(-1)
    return harness


def choose(harness: PlannerHarness, mode: int) -> list[int]:
    harness.worlds.state.mode.fill_(mode)
    return harness.choose(SEED)


def test_order_by_ancestors_then_visible_fraction_then_index(device):
    visible = [[1, 1, 1, 1], [0, 1, 1, 1], [0, 1, 0, 1], [0, 0, 0, 0]]
    fraction = [[0.1, 0.9, 0.5, 0.5]] * 4
    above = [[0b0000, 0b0001, 0b1001, 0b0011]] * 4
    harness = harness_of(device, visible, fraction, above)
    assert choose(harness, Mode.PICK) == [0, 1, 1, -1]
    assert choose(harness, Mode.TARGET) == [2, 2, 3, -1]
    harness.observation.ancestors.zero_()
    assert choose(harness, Mode.PICK) == [1, 1, 1, -1]
    assert choose(harness, Mode.TARGET) == [0, 2, 3, -1]


@pytest.mark.parametrize(
    ("failures", "picked", "targeted"),
    [
        ([0, 0, 0, 0], 0, 2),
        ([1, 0, 0, 0], 1, 2),
        ([1, 2, 0, 0], 0, 2),
        ([4, 2, 0, 0], 2, 2),
        ([0, 0, 1, 0], 0, 3),
        ([1025, 9, 1025, 3], 3, 3),
    ],
)
def test_a_failure_weighs_as_an_object_above_or_more_than_all_since_the_last_success(device, failures, picked, targeted):
    harness = harness_of(device, [1, 1, 1, 1], [0.1, 0.9, 0.5, 0.5], [0b0000, 0b0001, 0b1001, 0b0011])
    harness.attempts.target_failures.assign(np.array([failures]))
    assert (choose(harness, Mode.PICK), choose(harness, Mode.TARGET)) == ([picked], [targeted])


def test_ancestors_of_all_words_count(device):
    """Instance i has i ancestors, the last ones."""
    there = np.arange(MAX_INSTANCES)[None, :] >= MAX_INSTANCES - np.arange(MAX_INSTANCES)[:, None]
    octets = np.packbits(np.pad(there, ((0, 0), (0, 32 * count_words(MAX_INSTANCES) - MAX_INSTANCES))), axis=1, bitorder="little")
    harness = harness_of(device, [1] * MAX_INSTANCES, [0.5] * MAX_INSTANCES, octets.view(np.uint32))
    assert choose(harness, Mode.PICK) == [0]
    assert choose(harness, Mode.TARGET) == [MAX_INSTANCES - 1]


@given(rows=st.lists(st.tuples(st.integers(0, 1), st.sampled_from([0.2, 0.4, 0.9]), st.integers(0, 15)), min_size=1, max_size=6))
def test_targets_equal_the_reference(rows, device):
    visible, fraction, above = (np.array(column) for column in zip(*rows, strict=True))
    harness = harness_of(device, visible, fraction, above)
    counts = [int(bits).bit_count() for bits in above]
    assert choose(harness, Mode.PICK) == [planning.choose_target(visible, fraction, counts, False)]
    assert choose(harness, Mode.TARGET) == [planning.choose_target(visible, fraction, counts, True)]


# ---- random choice after a failure ----


def failed(device, worlds: int, outcome: Outcome, switch: int) -> PlannerHarness:
    harness = harness_of(device, [[1, 1, 0, 1, 1]] * worlds, [[0.5] * 5] * worlds, [[0, 1, 3, 0, 0]] * worlds)
    harness.worlds.scene.pick.random_after_failure = switch
    harness.attempts.outcome.fill_(int(outcome))
    harness.attempts.attempt.assign(np.arange(worlds) % 3)
    return harness


@pytest.mark.parametrize("outcome", list(Outcome))
@pytest.mark.parametrize("switch", [0, 1])
@pytest.mark.parametrize("mode", [Mode.PICK, Mode.TARGET])
def test_random_choice_only_after_failures_in_target_mode_if_enabled(device, outcome, switch, mode):
    harness = failed(device, 40, outcome, switch)
    fails = outcome not in (Outcome.NONE, Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)
    found = choose(harness, mode)
    is_random = bool(switch) and fails and mode == Mode.TARGET
    assert (len(set(found)) > 1) == is_random
    if not is_random:
        assert set(found) == {0 if mode == Mode.PICK else 1}


def test_random_choices_use_their_stream_and_are_uniform(device):
    worlds = 400
    harness = failed(device, worlds, Outcome.DROPPED, 1)
    arrangement = np.arange(worlds) % 2
    harness.worlds.begin(Phase.ACT, arrangement=arrangement)
    key = rng.stream_key(SEED, np.arange(worlds), arrangement, Stream.TARGETS)
    index = rng.uniform_index(key, np.arange(worlds) % 3 + 1, 4)
    found = np.array(choose(harness, Mode.TARGET))
    np.testing.assert_array_equal(found, np.array([0, 1, 3, 4])[index])
    assert (np.bincount(found, minlength=5)[[0, 1, 3, 4]] > worlds / 6).all()


def test_no_visible_instance_to_sample_from(device):
    harness = failed(device, 1, Outcome.NOTHING_CAUGHT, 1)
    harness.observation.visible.zero_()
    assert choose(harness, Mode.TARGET) == [-1]


def test_an_unused_view_keeps_the_target(device):
    harness = harness_of(device, [[1, 1]] * 2, [[0.5, 0.6]] * 2, [[0, 0]] * 2)
    harness.grasp.target.fill_(7)
    harness.images.views.world.assign(np.array([1, -1]))
    assert choose(harness, Mode.PICK) == [7, 1]


# ---- flat points, on synthetic images of angles and slopes ----


RADIUS = 0.1
"""Of the circle of rays [m]: in 1 m, its lip is 15 px from the middle."""
SQUARE = np.array([(10, 10), (110, 10), (110, 80), (10, 80)])


def angle(column: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A roof whose ridge, at this column, is its grasp point; both sides are planes: 1 / z is affine."""
    ids, _ = paint_shapes([(SQUARE, (0.0, 0.0, 1.0))])
    return ids, (1.0 / (1.0 - 0.004 * np.abs(np.arange(ids.shape[1]) - column)) + np.zeros(ids.shape)).astype(np.float32)


def chosen(device, images, failures=0, flat=True, seed=1, attempt=0, cups=((0.0, 0.0),), grasp=(60, 45)) -> np.ndarray:
    """Grasp pixels of one instance in each of the images (view, 2); the depth must be that of the pixel."""
    ids, depths = zip(*images, strict=True)
    harness = PlannerHarness(device, list(ids), list(depths), 1)
    harness.planner.flat = flat
    filled(harness.scene.suction, {"radius": RADIUS})
    harness.scene.cups.count, harness.scene.cups.place = len(cups), cup_places(cups, device)
    harness.worlds.begin(Phase.ACT)
    harness.arrays.distance.assign(harness.expected["distance"])
    harness.observation.distances.fill_(30.0)
    harness.observation.grasp_pixel.assign(np.full((len(ids), 1, 2), grasp))
    harness.attempts.target_failures.fill_(failures)
    harness.attempts.attempt.fill_(attempt)
    harness.planner.bound_contours(harness.scene, harness.worlds.state, harness.observation)
    harness.observation.depth.assign(np.array([[depth[grasp[1], grasp[0]]] for depth in depths]))
    harness.choose_flat_points(seed)
    pixels = harness.observation.grasp_pixel.numpy()[:, 0]
    for (_, depth), (column, row), z in zip(images, pixels, harness.observation.depth.numpy()[:, 0], strict=True):
        assert z == depth[row, column]
    return pixels


def lies_flat(pixel: np.ndarray, ridge: int = 60) -> bool:
    """Whether the lip, at 1 m or farther at most 15 px wide, is off the ridge and on the mask."""
    return abs(pixel[0] - ridge) > 9 and 20 <= pixel[0] <= 99 and 20 <= pixel[1] <= 69


def test_a_flat_grasp_point_stays_and_one_on_a_ridge_moves_off_it(device):
    plane = np.full((90, 120), 1.0, np.float32)
    stays, moves = chosen(device, [(angle()[0], plane), angle()])
    assert stays.tolist() == [60, 45]
    assert lies_flat(moves)


def test_it_moves_for_the_rule_or_after_a_failure(device):
    for flat, failures, moves in ((False, 0, False), (False, 1, True), (True, 0, True), (True, 2, True)):
        (pixel,) = chosen(device, [angle()], failures, flat)
        assert (pixel.tolist() != [60, 45]) == moves
        assert lies_flat(pixel) == moves


def test_each_attempt_has_points_of_its_own_which_follow_from_seed_and_episode(device):
    """A plane: the first sample is taken."""
    plane = (angle()[0], np.full((90, 120), 1.0, np.float32))
    draws = [chosen(device, [plane], 1, attempt=attempt)[0].tolist() for attempt in range(4)]
    assert len({tuple(pixel) for pixel in draws}) == 4
    assert chosen(device, [plane, plane], 1)[0].tolist() == draws[0]
    assert chosen(device, [plane], 1, seed=2)[0].tolist() != draws[0]


def test_a_wide_tool_needs_a_wide_plane(device):
    """Two cups 0.05 m from the middle need 20 px around it. Where the mask is too narrow for one, the point stays."""
    (pixel,) = chosen(device, [angle()], cups=((-0.05, 0.0), (0.05, 0.0)))
    assert abs(pixel[0] - 60) > 12
    narrow = paint_shapes([(np.array([(50, 10), (70, 10), (70, 80), (50, 80)]), (0.0, 0.0, 1.0))])
    assert chosen(device, [narrow])[0].tolist() == [60, 45]
