"""Order of episodes and their shares: the longest first, every episode once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Mode
from synpick_warp.configs.files.load import load_config
from synpick_warp.factory import order
from synpick_warp.factory.order import (
    DEVIATIONS,
    FRAMES_OF_MODE,
    SORTED_EPISODES,
    EpisodeSource,
    deal_episodes,
    deal_writers,
    order_longest_first,
)
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKED, boxes
from tests.harness.exporter_contract import digests
from tests.twins.arrangement import sample_modes, sample_objects
from tests.worlds.small_worlds import ANGLE, BOX, CUBE, catalog, settings

OBJECTS = catalog(BOX, CUBE, ANGLE)
SEED = 5


def predicted_frames(config, episodes, modes) -> np.ndarray:
    """Frames that the order goes by, from the twins of the sampling kernels."""
    frames = []
    for episode, mode in zip(episodes, modes, strict=True):
        fixed, each, deviation = FRAMES_OF_MODE[Mode(mode)]
        sampled = sample_objects(
            SEED,
            int(episode),
            0,
            volume=np.array([entry.volume for entry in OBJECTS.entries]),
            compound=np.zeros(len(OBJECTS)),
            budget=config.arrangement.volume,
            exceed=config.arrangement.fill == "exceed",
            repeats=config.move.repeats if mode == Mode.MOVE else config.pick.repeats,
            room=config.arrangement.max_objects,
            single_slots=config.arrangement.max_objects,
            compound_slots=0,
        )
        frames.append(fixed + each * len(sampled.entries) + DEVIATIONS * deviation)
    return np.array(frames)


def test_the_episodes_that_may_be_longest_come_first(device):
    config = load_config("smoke", {"bake.mode": "mixed", "bake.mix": [2.0, 1.0, 1.0], "bake.seed": SEED, "pick.repeats": True})
    found = order_longest_first(config, OBJECTS, range(60), device)
    modes = sample_modes(SEED, np.arange(60), (2.0, 1.0, 1.0))
    frames = predicted_frames(config, range(60), modes)
    assert set(modes) == set(Mode)
    assert len(set(frames.tolist())) > len(Mode)
    assert found == np.argsort(-frames, kind="stable").tolist()


def test_many_episodes_stay_mixed_but_for_the_last(device):
    config, count = load_config("smoke", {"bake.mode": "cycle", "bake.seed": SEED}), SORTED_EPISODES + 30
    found = order_longest_first(config, OBJECTS, range(count), device)
    assert found[:30] == list(range(30))
    assert sorted(found[30:]) == list(range(30, count))
    modes = np.array([Mode.PICK, Mode.TARGET, Mode.MOVE])[np.arange(count) % 3]
    frames = predicted_frames(config, range(count), modes)[found[30:]]
    assert (np.diff(frames) <= 0).all()


def test_only_the_episodes_that_are_sorted_are_sampled(device, monkeypatch):
    """A million episodes times their objects would take seconds, and more memory than is planned."""
    sampled = []

    def sample(config, catalog, episodes, device):
        sampled.extend(episodes.tolist())
        return np.full(len(episodes), Mode.MOVE), np.zeros(len(episodes))

    monkeypatch.setattr(order, "sample_episodes_ahead", sample)
    found = order_longest_first(load_config("smoke", {}), OBJECTS, range(10**6), device)
    assert found == list(range(10**6))
    assert sampled == found[-SORTED_EPISODES:]


def test_episodes_of_equal_length_stay_in_order(device):
    assert order_longest_first(load_config("smoke", {"bake.mode": "move"}), OBJECTS, [4, 1, 3], device) == [1, 3, 4]


def test_no_episodes(device):
    assert order_longest_first(load_config("smoke", {}), OBJECTS, [], device) == []


def test_splits_of_different_modes(tmp_path, device):
    settings = tmp_path / "splits.toml"
    settings.write_text('[splits.train]\nepisodes = 2\nmode = "move"\n[splits.test]\nepisodes = 2\nmode = "target"\n')
    config = load_config(str(settings), {"arrangement.max_objects": 7, "arrangement.volume": 1.0, "pick.repeats": True})
    assert order_longest_first(config, OBJECTS, range(4), device) == [2, 3, 0, 1]


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


@pytest.mark.slow
def test_episodes_that_come_while_worlds_are_idle_have_the_bytes_of_one_bake(picked_set, tmp_path):
    class Source(EpisodeSource):
        def more(self, wait: bool) -> list[int]:
            return [rest.pop()] if rest else []

    rest = [0]
    with boxes():
        summary = bake_episodes(settings(**PICKED), tmp_path / "grown", SilentProgress(), Source([1]))
    assert not rest
    assert (summary.total, len(summary.episodes)) == (2, 2)
    assert digests(tmp_path / "grown") == digests(picked_set)
