"""Assignment of episodes to worlds, and resampling of episodes that ended without delivery."""

from __future__ import annotations

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Phase
from synpick_warp.stages.sim import arrange
from tests.worlds.kernel_worlds import arrangement_worlds


def assign(device, phase, ending, arrangement_id, following: int, *, episodes: int, tries: int):
    """Phase, ending, arrangement id and position in the list of episodes after one assignment."""
    worlds = arrangement_worlds(device, len(phase))
    state = worlds.state
    for array, values in (
        (state.phase, phase),
        (state.ending, ending),
        (state.arrangement_id, arrangement_id),
        (state.next_episode, following),
    ):
        worlds.set(array, values)
    arrange.assign_episodes(state, wp.array(np.arange(episodes), dtype=wp.int32, device=device), tries)
    return (
        state.phase.numpy().tolist(),
        state.ending.numpy().tolist(),
        state.arrangement_id.numpy().tolist(),
        int(state.next_episode.numpy()[0]),
    )


def test_episodes_are_those_of_the_list(device):
    worlds = arrangement_worlds(device, 3)
    worlds.begin(Phase.EMPTY, -1)
    arrange.assign_episodes(worlds.state, wp.array([7, 2], dtype=wp.int32, device=device), 1)
    assert worlds.state.arrangement_id.numpy().tolist() == [[7, 0], [2, 0], [-1, 0]]
    assert worlds.state.phase.numpy().tolist() == [Phase.START, Phase.START, Phase.IDLE]


def test_empty_worlds_take_episodes_in_order(device):
    assert assign(device, [Phase.EMPTY] * 3, 0, -1, 0, episodes=2, tries=1) == (
        [Phase.START, Phase.START, Phase.IDLE],
        [0, 0, 0],
        [[0, 0], [1, 0], [-1, 0]],
        2,
    )


def test_an_episode_without_delivery_is_resampled_in_its_world_until_it_is_given_up(device):
    over = [Phase.OVER] * 4
    ending = [Ending.UNSETTLED, Ending.FINISHED, Ending.NOT_FINITE, Ending.UNSETTLED]
    arrangement_id = [[3, 0], [4, 0], [5, 1], [6, 2]]
    assert assign(device, over, ending, arrangement_id, 9, episodes=100, tries=3) == (
        [Phase.START] * 4,
        [Ending.RUNNING] * 4,
        [[3, 1], [9, 0], [5, 2], [10, 0]],
        11,
    )


def test_busy_worlds_keep_their_episodes(device):
    phase = [Phase.SETTLE, Phase.ACT, Phase.IDLE]
    assert assign(device, phase, 0, [[0, 0], [1, 0], [-1, 0]], 2, episodes=9, tries=3) == (phase, [0, 0, 0], [[0, 0], [1, 0], [-1, 0]], 2)


def test_idle_worlds_that_are_freed_take_episodes_of_another_list(device):
    worlds = arrangement_worlds(device, 3)
    worlds.set(worlds.state.phase, [Phase.IDLE, Phase.ACT, Phase.IDLE])
    worlds.set(worlds.state.arrangement_id, [[-1, 0], [4, 1], [-1, 0]])
    arrange.free_idle_worlds(worlds.state)
    arrange.assign_episodes(worlds.state, wp.array([8], dtype=wp.int32, device=device), 1)
    assert worlds.state.arrangement_id.numpy().tolist() == [[8, 0], [4, 1], [-1, 0]]
    assert worlds.state.phase.numpy().tolist() == [Phase.START, Phase.ACT, Phase.IDLE]


@given(worlds=st.integers(1, 6), episodes=st.integers(1, 20), tries=st.integers(1, 4), seed=st.integers(0, 2**32 - 1))
def test_every_episode_ends_once(worlds, episodes, tries, seed, device):
    """With random endings, each episode is delivered or given up exactly once; then all worlds are idle."""
    numbers = np.random.default_rng(seed)
    kernel_worlds = arrangement_worlds(device, worlds)
    state = kernel_worlds.state
    kernel_worlds.begin(Phase.EMPTY, -1)
    started, ended = [], []
    listed = wp.array(np.arange(episodes), dtype=wp.int32, device=device)
    for _ in range(8 * episodes * tries):
        arrange.assign_episodes(state, listed, tries)
        phase, ending, arrangement_id = state.phase.numpy(), state.ending.numpy(), state.arrangement_id.numpy()
        started += [tuple(arrangement_id[world]) for world in np.flatnonzero(phase == Phase.START)]
        for world in np.flatnonzero(phase != Phase.IDLE):
            phase[world], ending[world] = Phase.ACT, Ending.RUNNING
            if numbers.uniform() < 0.5:
                phase[world], ending[world] = Phase.OVER, numbers.choice([Ending.FINISHED, Ending.UNSETTLED])
                if ending[world] == Ending.FINISHED or arrangement_id[world, 1] == tries - 1:
                    ended.append(int(arrangement_id[world, 0]))
        if (phase == Phase.IDLE).all():
            break
        kernel_worlds.set(state.phase, phase)
        kernel_worlds.set(state.ending, ending)
    assert (state.phase.numpy() == Phase.IDLE).all()
    assert sorted(ended) == list(range(episodes))
    assert len(set(started)) == len(started)
    assert [episode for episode, arrangement in started if arrangement == 0] == list(range(episodes))
    assert (state.arrangement_id.numpy()[:, 0] == -1).all()
