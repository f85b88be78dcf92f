"""Settings that all writers of a data set share; and its splits: which episodes each one has, in which modes (gripper tasks), and where its
BOP scenes are.

Episode indices are unique in a data set: each split is a range of them. Random streams are keyed by seed and episode index, so splits
share none; scene ids follow from episode indices, so a scene id names one scene of the whole data set. Without splits there is one range,
from 0 to `bake.episodes`, in the folder `bop.split`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.cell.cameras import Rig, effect_ranges
from synpick_warp.configs.check import to_index
from synpick_warp.configs.schema import CYCLE, MIXED, MODES, MULTISENSOR, Bake, Bop, Config, Gripper, Physics, Render, Split, Trajectory
from synpick_warp.errors import ConfigError, format_value, suggest


@dataclass(frozen=True)
class ExportSettings:
    """Settings by which files are written: what all views and episodes of a data set have in common."""

    layout: "DataLayout"
    bake: Bake
    bop: Bop
    rig: Rig
    physics: Physics
    render: Render
    trajectory: Trajectory
    gripper: Gripper
    bins: tuple[BinSizes, ...]
    """Bins from which an episode draws its own."""
    effects: tuple[str, ...]
    """Names of the camera effects that are on."""
    objects: int
    """Maximum number of objects of an episode."""

    @classmethod
    def of(cls, config: Config) -> "ExportSettings":
        """Those of all settings."""
        effects = tuple(name for name, limits in effect_ranges(config.effects).items() if any(limits))
        names = ("bake", "bop", "rig", "physics", "render", "trajectory", "gripper")
        sections: dict[str, Any] = {name: getattr(config, name) for name in names}
        return cls(layout=DataLayout.of(config), bins=config.cell.bins, effects=effects, objects=config.arrangement.max_objects, **sections)

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes of the data set or of its splits."""
        return bake_modes(self.bake, self.layout.splits)


MAX_SHARD_SCENES = 1_000_000
"""Scene ids that the names of shards (format shards) tell apart: part p of a scene is shard scene_id + p · this."""


def episode_range(split: Split) -> range:
    """Episode indices of a split."""
    return range(split.first, split.first + split.episodes)


def choose_splits(splits: tuple[Split, ...], names: Sequence[str]) -> tuple[Split, ...]:
    """Return the named splits in the order of the settings, or all without names. Raises ConfigError: an unknown split."""
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise ConfigError(f'splits are {format_value(names)}; allowed: a list of names, such as ["train"]')
    if not names:
        return splits
    known = [split.name for split in splits]
    if not known:
        raise ConfigError(f"there is no split {format_value(names[0])}: the settings have no splits; add tables such as [splits.train]")
    for name in names:
        if name not in known:
            raise ConfigError(f"there is no split {format_value(name)}; splits: {', '.join(known)}{suggest(name, known)}")
    return tuple(split for split in splits if split.name in names)


def check_shard(shard: tuple[int, int], name: str = "shard") -> None:
    """Validate a shard (i, n); arguments as in `DataLayout.plan_shard`. Raises ConfigError: not two whole numbers with 0 <= i < n."""
    if not isinstance(shard, tuple | list) or len(shard) != 2 or any(to_index(part) is None for part in shard):
        raise ConfigError(f"{name} is {shard!r}; allowed: (i, n) with i from 0 to n - 1, such as (0, 4)")
    index, count = shard
    if not 0 <= index < count:
        raise ConfigError(f"{name} is {index}/{count}; allowed: i/n with i from 0 to n - 1, such as 0/4")


@dataclass(frozen=True)
class DataLayout:
    """Layout of a data set: the formats, episodes and cameras that it has, and the folders and ids of its BOP scenes."""

    formats: tuple[str, ...]
    splits: tuple[Split, ...]
    """By first episode; empty: one range of episodes in one folder."""
    episodes: int
    """Number of episodes without splits."""
    split: str
    """BOP folder without splits."""
    names: tuple[str, ...]
    sensor_names: tuple[str, ...]
    """Their names as sensors of a scene."""
    every: tuple[int, ...]
    """Frames from one picture of each camera to the next."""
    has_sensors: bool
    """Whether the cameras of an episode share a scene, as its sensors; else each has a scene of its own."""

    @classmethod
    def of(cls, config: Config) -> "DataLayout":
        """Layout by the settings of a bake."""
        bake, bop, rig = config.bake, config.bop, config.rig
        return cls(bake.formats, config.splits, bake.episodes, bop.split, rig.names, rig.sensors, rig.every, bop.layout == MULTISENSOR)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.names)

    def frames(self, camera: int, count: int) -> range:
        """Frames of which a camera has pictures, of an episode with `count` frames."""
        return range(0, count, self.every[camera])

    @property
    def is_listed(self) -> bool:
        """Whether the cameras are those of [[camera]] tables, with names of their own."""
        return self.names == self.sensor_names

    def plan(self, names: Sequence[str] = (), shard: tuple[int, int] = (0, 1)) -> list[range]:
        """Episode indices of a bake, ascending, one range per split; arguments as of `plan_shard`. Raises ConfigError: an unknown split."""
        index, count = shard
        splits = choose_splits(self.splits, names)
        ranges = [episode_range(split) for split in splits] if splits else [range(self.episodes)]
        return [range(each.start + (index - each.start) % count, each.stop, count) for each in ranges]

    @property
    def planned(self) -> int:
        """Number of episodes, of all splits."""
        return sum(map(len, self.plan()))

    def plan_shard(self, names: Sequence[str], shard: tuple[int, int], name: str = "shard") -> list[range]:
        """Validate a shard and return its episode indices, ascending, one range per split. `names`: splits; empty: all. `shard`: (i, n):
        only indices with index % n == i. `name`: name of the shard in messages, such as that of the option. Raises ConfigError: an unknown
        split, an invalid shard, or a shard without episodes."""
        check_shard(shard, name)
        planned = self.plan(names, shard)
        if not any(planned):
            total = sum(map(len, self.plan(names)))
            raise ConfigError(f"{name} {shard[0]}/{shard[1]} has none of {total} episodes; use fewer shards")
        return planned

    def is_planned(self, episode: int) -> bool:
        """Whether an episode index belongs to the planned episodes."""
        return any(episode in each for each in self.plan())

    @property
    def episodes_end(self) -> int:
        """Exclusive upper bound of the planned episode indices, over all splits."""
        return max(each.stop for each in self.plan())

    def split_of(self, episode: int) -> Split | None:
        """Split of an episode index; None if there are no splits.

        An index between two splits belongs to the earlier one, an index below all splits to the first.
        """
        return next((split for split in reversed(self.splits) if split.first <= episode), self.splits[0] if self.splits else None)

    @property
    def folders(self) -> tuple[str, ...]:
        """Names of all split folders."""
        return tuple(split.folder for split in self.splits) or (self.split,)

    def folder(self, episode: int) -> str:
        """Name of the split folder with an episode's BOP scenes, such as "train_pbr"."""
        split = self.split_of(episode)
        return self.split if split is None else split.folder

    def scene(self, episode: int, camera: int) -> tuple[int, str]:
        """Scene id of a camera's images of an episode, and the suffix of their files: empty, or that of the sensor, such as "_cam1"."""
        return (episode, f"_{self.sensor_names[camera]}") if self.has_sensors else (self.cameras * episode + camera, "")

    def scene_ids(self, episodes: Iterable[int]) -> set[int]:
        """Ids of all BOP scenes of episodes."""
        return {self.scene(episode, camera)[0] for episode in episodes for camera in range(self.cameras)}

    def scene_episode(self, scene: int) -> int:
        """Episode of a BOP scene."""
        return scene if self.has_sensors else scene // self.cameras

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors of a scene; none if each camera has a scene of its own."""
        return self.sensor_names if self.has_sensors else ()


def split_kind(folder: str) -> str:
    """Name of a BOP split without its type: "train" for the folder "train_pbr"."""
    return folder.partition("_")[0]


def mode_weights(bake: Bake, mode: str | None = None) -> dict[str, float]:
    """Unnormalized probability of modes in a bake of mode `mode` (None: bake.mode); 0: never."""
    mode = bake.mode if mode is None else mode
    if mode == MIXED:
        return dict(zip(MODES, bake.mix, strict=True))
    return {name: float(mode in (name, CYCLE)) for name in dict.fromkeys((*MODES, mode)) if name != CYCLE}


def bake_modes(bake: Bake, splits: Sequence[Split]) -> tuple[str, ...]:
    """Modes of the settings, each once: those of the splits, or without splits `bake.mode`."""
    return tuple(dict.fromkeys(split.mode for split in splits)) or (bake.mode,)


def possible_modes(bake: Bake, splits: Sequence[Split]) -> set[str]:
    """Modes, mixed and cycle resolved, that episodes of a data set with these settings can have."""
    return {name for mode in bake_modes(bake, splits) for name, weight in mode_weights(bake, mode).items() if weight > 0.0}


def may_pick(bake: Bake, splits: Sequence[Split]) -> bool:
    """Whether a bake can have episodes in mode pick or target."""
    return not possible_modes(bake, splits).isdisjoint({"pick", "target"})
