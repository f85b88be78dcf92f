"""Order of episodes: longest processing time first (LPT; Graham, 1969) among the last ones, and the episodes of each device.

The episodes that start last determine when a bake ends, so the longest of them start first; those before start by index. No episode
depends on the order or on its device.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from synpick_warp.codes import Mode
from synpick_warp.configs.modes import possible_modes
from synpick_warp.configs.schema import Config
from synpick_warp.stages.sim.arrange import sample_modes_of

EXPECTED_FRAMES = {Mode.TARGET: 638, Mode.PICK: 502, Mode.MOVE: 416}
"""Mean frames of an episode: tools/README.md, "Picking", and for MOVE those of the paper's data set."""


SORTED_EPISODES = 1024
"""Number of episodes at the end of the list that are sorted: two rounds of MAX_GPU_WORLDS. Before them modes stay mixed, which keeps
progress and load even."""


def order_longest_first(config: Config, episodes: Sequence[int], device: wp.Device) -> list[int]:
    """Sort the last SORTED_EPISODES episodes by the expected frames of their mode, the longest first, and then by index.

    Args:
        config: All settings.
        episodes: Indices.
        device: Device that samples the modes.
    """
    if len(possible_modes(config)) == 1:
        return sorted(episodes)
    indices = np.sort(np.asarray(episodes, np.int32))
    frames = np.array([EXPECTED_FRAMES[mode] for mode in sorted(Mode)])[sample_modes_of(config, indices, device)]
    first = max(0, len(indices) - SORTED_EPISODES)
    order = np.concatenate([np.arange(first), first + np.argsort(-frames[first:], kind="stable")])
    return indices[order].tolist()


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
