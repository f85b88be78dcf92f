"""Order of episodes: longest processing time first (LPT; Graham, 1969) among the last ones, and the episodes of each device.

The episodes that start last determine when a bake ends, so the longest of them start first; those before start by index. No episode
depends on the order or on its device.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import warp as wp

from synpick_warp.codes import Mode
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim.arrange import sample_episodes_ahead

FRAMES_OF_MODE = {Mode.PICK: (60, 44, 102), Mode.TARGET: (81, 51, 75), Mode.MOVE: (409, 0, 33)}
"""Frames of an episode: fixed part, part per object, and standard deviation. Least squares over 56 episodes of real objects
(tools/results/episodes_lengths.json)."""
DEVIATIONS = 2.0
"""Standard deviations above the mean by which episodes are ordered, so that those that may become long start early, too.
In a Monte Carlo of 150 mixed episodes in 100 worlds a bake is 1 % faster than in the order of the means."""

SORTED_EPISODES = 1024
"""Number of episodes at the end of the list that are sorted: two rounds of MAX_GPU_WORLDS. Before them modes stay mixed, which keeps
progress and load even."""


class EpisodeSource(list[int]):
    """Work queue of a bake: a list of the episodes that it begins with, sorted, and a source of further ones while worlds are idle."""

    def __init__(self, episodes: Iterable[int], expected: int = 0) -> None:
        super().__init__(episodes)
        self.expected = expected
        """Number of episodes to choose worlds for, if it is larger than that of the first ones, and the settings leave it open."""

    def more(self, wait: bool) -> list[int]:
        """Further episodes, which were never returned before; empty: none at present. `wait`: the bake ends if there are none."""
        del wait
        return []


def predict_frames(modes: np.ndarray, objects: np.ndarray, deviations: float = 0.0) -> np.ndarray:
    """Predicted frames of episodes (episode), from their modes and numbers of objects: the mean plus `deviations` standard deviations."""
    fixed, each, deviation = np.array([FRAMES_OF_MODE[Mode(mode)] for mode in modes.tolist()]).reshape(-1, 3).T
    return fixed + each * objects + deviations * deviation


def order_longest_first(config: Config, catalog: Catalog, episodes: Sequence[int], device: wp.Device) -> list[int]:
    """Sort the last SORTED_EPISODES episodes by `predict_frames`, the longest first, then by index; `device` samples modes and objects."""
    indices = np.sort(np.asarray(episodes, np.int32))
    if not len(indices):
        return []
    first, last = indices[:-SORTED_EPISODES], indices[-SORTED_EPISODES:]
    frames = predict_frames(*sample_episodes_ahead(config, catalog, last, device), DEVIATIONS)
    return [*first.tolist(), *last[np.argsort(-frames, kind="stable")].tolist()]


def deal_episodes(ordered: Sequence[int], devices: int) -> list[list[int]]:
    """Deal ordered episodes to devices in snake order (0, 1, 1, 0, 0, ...), which balances their loads; a list for each device."""
    turns = [*range(devices), *reversed(range(devices))]
    shares: list[list[int]] = [[] for _ in range(devices)]
    for position, episode in enumerate(ordered):
        shares[turns[position % len(turns)]].append(episode)
    return shares


def deal_writers(writers: int, devices: int) -> list[int]:
    """Split writer processes evenly among devices: shares differ by at most one, and each is at least one, even of fewer writers."""
    return [max(1, writers // devices + (device < writers % devices)) for device in range(devices)]
