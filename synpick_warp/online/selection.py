"""Selection of what a stream delivers: which episodes, and of these which cameras and frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from synpick_warp.configs.check import to_index
from synpick_warp.configs.dataset.splits import DataLayout, check_shard
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.errors import ConfigError
from synpick_warp.factory.memory_plan import check_episodes


@dataclass(frozen=True)
class Selection:
    """Cameras and frames of each episode; what is left out is not rendered.

    The other views keep their poses, depth and masks. With a stride above 1 their light is not averaged over frames (`render.history`).
    """

    cameras: Sequence[int] | None = None
    """Indices of the cameras; None: all."""
    stride: int = 1
    """Every n-th frame of an episode, from the first on."""

    def resolve(self, count: int) -> Selection:
        """Selection with all its cameras named, out of `count` cameras.

        Raises:
            ConfigError: There is no such camera, or a value is out of range.
        """
        given = range(count) if self.cameras is None else self.cameras
        cameras = tuple(to_index(camera) for camera in given) if isinstance(given, Iterable) else ()
        if not cameras or len(set(cameras)) < len(cameras) or not set(cameras) <= set(range(count)):
            raise ConfigError(f"cameras are {list(given) if cameras else given}; allowed: one or more of 0 to {count - 1}, each once")
        stride = to_index(self.stride)
        if stride is None or stride < 1:
            raise ConfigError(f"stride is {self.stride!r}; allowed: a whole number from 1 on")
        return replace(self, cameras=cameras, stride=stride)


def choose_episodes(
    layout: DataLayout, episodes: int | range | None, shard: tuple[int, int], splits: Sequence[str]
) -> tuple[int, list[int]]:
    """Choose the episode indices of a stream, in order.

    Args:
        layout: Layout by the settings.
        episodes: How many, from 0 on, or their indices; None: those that the settings plan.
        shard: (i, n): only indices with index % n == i.
        splits: Only episodes of these splits; empty: all.

    Returns:
        `bake.episodes` of settings that plan these episodes, and the indices.

    Raises:
        ConfigError: There is no such split, an index is out of range, or `episodes` are given beside splits.
    """
    check_shard(shard)
    index, count = shard
    if episodes is None:
        return layout.episodes, [episode for each in layout.plan(splits, shard) for episode in each]
    if splits or layout.splits:
        raise ConfigError("episodes are given beside splits, which name their episodes; give one of both")
    chosen = range(episodes) if isinstance(episodes, int) else episodes
    # The ends of a range: min and max would go through all of it.
    if not isinstance(chosen, range) or not chosen or min(chosen[0], chosen[-1]) < 0 or max(chosen[0], chosen[-1]) >= INT32_MAX:
        raise ConfigError(f"episodes are {episodes!r}; allowed: how many, or a range of indices from 0 to {INT32_MAX - 1}")
    planned = max(chosen[0], chosen[-1]) + 1
    check_episodes(-(-len(chosen) // count), planned)
    return planned, [episode for episode in chosen if episode % count == index]
