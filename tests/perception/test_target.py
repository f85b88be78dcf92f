"""Which object is picked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Mode, Outcome, Phase, Stream
from tests.twins import planning, rng
from tests.twins.planning import Looks

EMPTY = np.full((4, 4), -1), np.ones((4, 4))
SEED = 9


def looks(device, visible, share, all_above) -> Looks:
    """One world and view a row."""
    visible = np.atleast_2d(visible)
    made = Looks(device, [EMPTY[0]] * len(visible), [EMPTY[1]] * len(visible), visible.shape[1])
    made.sighting.visible.assign(visible)
    made.sighting.share.assign(np.atleast_2d(share))
    made.sighting.all_above.assign(np.atleast_2d(all_above).astype(np.uint32))
    made.worlds.begin(Phase.ACT)
    made.attempts.attempt.fill_(-1)
    return made


def chosen(made: Looks, mode: int) -> list[int]:
    made.worlds.state.mode.fill_(mode)
    return made.choose(SEED)


def test_objects_above_come_first_then_the_share_then_the_index(device):
    visible = [[1, 1, 1, 1], [0, 1, 1, 1], [0, 1, 0, 1], [0, 0, 0, 0]]
    share = [[0.1, 0.9, 0.5, 0.5]] * 4
    above = [[0b0000, 0b0001, 0b1001, 0b0011]] * 4
    made = looks(device, visible, share, above)
    assert chosen(made, Mode.PICK) == [0, 1, 1, -1]
    assert chosen(made, Mode.TARGET) == [2, 2, 3, -1]
    made.sighting.all_above.zero_()
    assert chosen(made, Mode.PICK) == [1, 1, 1, -1]
    assert chosen(made, Mode.TARGET) == [0, 2, 3, -1]


def test_more_than_sixteen_objects_above(device):
    made = looks(device, [1] * 32, [0.5] * 32, [0xFFFFFFFE] + [0x7FFF0000] * 31)
    assert chosen(made, Mode.TARGET) == [0]
    assert chosen(made, Mode.PICK) == [1]


@given(rows=st.lists(st.tuples(st.integers(0, 1), st.sampled_from([0.2, 0.4, 0.9]), st.integers(0, 15)), min_size=1, max_size=6))
def test_choices_are_the_twins(rows, device):
    visible, share, above = (np.array(column) for column in zip(*rows, strict=True))
    made = looks(device, visible, share, above)
    counts = [int(bits).bit_count() for bits in above]
    assert chosen(made, Mode.PICK) == [planning.choice(visible, share, counts, False)]
    assert chosen(made, Mode.TARGET) == [planning.choice(visible, share, counts, True)]


# ---- at random after a failure ----


def failed(device, worlds: int, outcome: Outcome, switch: int) -> Looks:
    made = looks(device, [[1, 1, 0, 1, 1]] * worlds, [[0.5] * 5] * worlds, [[0, 1, 3, 0, 0]] * worlds)
    made.worlds.scene.pick.random_after_failure = switch
    made.attempts.outcome.fill_(int(outcome))
    made.attempts.attempt.assign(np.arange(worlds) % 3)
    return made


@pytest.mark.parametrize("outcome", list(Outcome))
@pytest.mark.parametrize("switch", [0, 1])
@pytest.mark.parametrize("mode", [Mode.PICK, Mode.TARGET])
def test_only_failures_in_target_mode_draw_and_only_if_told_so(device, outcome, switch, mode):
    made = failed(device, 40, outcome, switch)
    fails = outcome not in (Outcome.NONE, Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)
    found = chosen(made, mode)
    draws_at_random = bool(switch) and fails and mode == Mode.TARGET
    assert (len(set(found)) > 1) == draws_at_random
    if not draws_at_random:
        assert set(found) == {0 if mode == Mode.PICK else 1}


def test_draws_have_their_address_and_are_even(device):
    worlds = 400
    made = failed(device, worlds, Outcome.DROPPED, 1)
    redraw = np.arange(worlds) % 2
    made.worlds.begin(Phase.ACT, redraw=redraw)
    key = rng.stream_key(SEED, np.arange(worlds), redraw, Stream.TARGETS)
    index = rng.uniform_index(key, np.arange(worlds) % 3 + 1, 4)
    found = np.array(chosen(made, Mode.TARGET))
    np.testing.assert_array_equal(found, np.array([0, 1, 3, 4])[index])
    assert (np.bincount(found, minlength=5)[[0, 1, 3, 4]] > worlds / 6).all()


def test_nothing_to_draw_from(device):
    made = failed(device, 1, Outcome.NOTHING_CAUGHT, 1)
    made.sighting.visible.zero_()
    assert chosen(made, Mode.TARGET) == [-1]


def test_an_unused_view_keeps_the_target(device):
    made = looks(device, [[1, 1]] * 2, [[0.5, 0.6]] * 2, [[0, 0]] * 2)
    made.target.target.fill_(7)
    made.look.world.assign(np.array([1, -1]))
    assert chosen(made, Mode.PICK) == [7, 1]
