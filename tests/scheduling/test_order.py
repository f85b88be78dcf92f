"""Order of episodes and their shares: the longest modes first, every episode once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Mode
from synpick_warp.configs.load import load_config
from synpick_warp.scheduling.order import EXPECTED_FRAMES, SORTED_EPISODES, deal_episodes, deal_writers, order_longest_first
from tests.twins.arrangement import sample_modes


def test_mixed_episodes_begin_with_the_longest_modes(device):
    config = load_config("smoke", {"bake.mode": "mixed", "bake.mix": [2.0, 1.0, 1.0], "bake.episodes": 60, "bake.seed": 5})
    order = order_longest_first(config, range(60), device)
    modes = sample_modes(5, np.arange(60), (2.0, 1.0, 1.0))
    assert [modes[episode] for episode in order] == sorted(modes, key=lambda mode: -EXPECTED_FRAMES[Mode(mode)])
    assert set(modes) == set(Mode)
    for mode in Mode:
        assert [episode for episode in order if modes[episode] == mode] == np.flatnonzero(modes == mode).tolist()


def test_many_episodes_stay_mixed_but_for_the_last(device):
    config, count = load_config("smoke", {"bake.mode": "cycle"}), SORTED_EPISODES + 30
    order = order_longest_first(config, range(count), device)
    assert order[:30] == list(range(30))
    assert sorted(order[30:]) == list(range(30, count))
    assert [episode % 3 for episode in order[30:]] == sorted((episode % 3 for episode in range(30, count)), key=[1, 0, 2].index)


def test_modes_in_turn(device):
    """Modes of a cycle are pick, target, move; each device of three gets every mode."""
    config = load_config("smoke", {"bake.mode": "cycle", "bake.episodes": 9})
    assert order_longest_first(config, [8, 0, 1, 2, 3, 4, 5, 6, 7], device) == [1, 4, 7, 0, 3, 6, 2, 5, 8]
    assert [sorted(episode % 3 for episode in share) for share in deal_episodes([1, 4, 7, 0, 3, 6, 2, 5, 8], 3)] == 3 * [[0, 1, 2]]


@pytest.mark.parametrize("mode", ["pick", "target", "move"])
def test_episodes_of_one_mode_stay_in_order(mode):
    assert order_longest_first(load_config("smoke", {"bake.mode": mode}), [4, 1, 3], device=None) == [1, 3, 4]  # type: ignore[arg-type]


def test_splits_of_different_modes(tmp_path, device):
    settings = tmp_path / "splits.toml"
    settings.write_text('[splits.train]\nepisodes = 2\nmode = "move"\n[splits.test]\nepisodes = 2\nmode = "target"\n')
    assert order_longest_first(load_config(str(settings), {}), range(4), device) == [2, 3, 0, 1]


@given(episodes=st.lists(st.integers(0, 999), unique=True, max_size=50), devices=st.integers(1, 8))
def test_every_episode_is_dealt_once_and_in_order(episodes, devices):
    shares = deal_episodes(episodes, devices)
    assert sorted(episode for share in shares for episode in share) == sorted(episodes)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert all(share == sorted(share, key=episodes.index) for share in shares)


def test_episodes_are_dealt_there_and_back():
    assert deal_episodes(range(7), 2) == [[0, 3, 4], [1, 2, 5, 6]]


@pytest.mark.parametrize(("writers", "devices", "dealt"), [(16, 2, [8, 8]), (17, 4, [5, 4, 4, 4]), (2, 3, [1, 1, 1]), (16, 1, [16])])
def test_writers_are_shared_out(writers, devices, dealt):
    assert deal_writers(writers, devices) == dealt
