"""Settings of a stream: a preset, a file or a `Config`, overridden by full keys and by keyword arguments; and which episodes, and of these
which cameras and frames it delivers."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from synpick_warp.configs.check import to_index
from synpick_warp.configs.dataset import DataLayout, check_shard
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.files.load import override_config
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.factory.memory_plan import check_episodes
from synpick_warp.scenes.bin_meshes.loading import load_settings, measure_meshes

ARGUMENTS = {
    "worlds": "bake.worlds",
    "device": "bake.device",
    "seed": "bake.seed",
    "mode": "bake.mode",
    "models": "bake.models",
    "lights": "bake.lights",
    "resolution": "cameras.resolution",
    "layers": "render.layers",
    "batch": "render.views_per_batch",
}
"""Full key of the setting that each keyword argument of `synpick_warp.stream` overrides."""


def resolve_settings(
    config: Config | Path | str | None, settings: Mapping[str, object], arguments: Mapping[str, object], splits: bool = False
) -> Config:
    """Resolve the settings of a stream: arguments by the keys of ARGUMENTS (None: not given) override full keys, such as "bake.mode", and
    both the configuration, or that of a preset or .toml file; None: the default preset. `splits`: whether the splits that a preset defines
    apply; those of a file always do. Raises ConfigError if a setting is unknown or not allowed."""
    given = {ARGUMENTS[name]: value for name, value in arguments.items() if value is not None}
    if given.get("bake.worlds") == "auto":  # As the command line has it.
        given["bake.worlds"] = 0
    overrides = dict(settings) | given
    if not isinstance(config, Config):
        return load_settings(config, overrides, splits=splits)
    config = override_config(config, overrides)
    return override_config(config, measure_meshes(config.bin, config.gripper))


@dataclass(frozen=True)
class Selection:
    """Cameras and frames of each episode; what is left out is not rendered.

    The other views keep their poses, depth and masks. With a stride above 1 their light is not averaged over frames (`render.history`).
    """

    cameras: Sequence[int] | None = None
    """Indices of the cameras; None: all."""
    stride: int = 1
    """Every n-th frame of an episode, from the first on."""

    def resolve(self, count: int) -> "Selection":
        """Selection with all its cameras named, out of `count` cameras; raises ConfigError if there is no such camera, or a value is out of
        range."""
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
    """Choose the episode indices of a stream, in order; returns `bake.episodes` of settings that plan these episodes, and the indices.

    `episodes` are how many, from 0 on, or their indices, None: those that the settings plan; `shard` (i, n): only indices with index % n ==
    i; `splits`: only their episodes, empty: all. Raises ConfigError if there is no such split, an index is out of range, or `episodes` are
    given beside splits."""
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
