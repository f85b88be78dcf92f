"""Forecast of a bake, views, size on disk and time, and order of its episodes: longest processing time first (LPT; Graham, 1969).

The episodes that start last determine when a bake ends, so the longest of them start first; those before start by index. No episode
depends on the order or on its device.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from synpick_warp.codes import Mode
from synpick_warp.configs.episodes.manipulation import Move
from synpick_warp.configs.schema import Config, Physics
from synpick_warp.errors import OutputError
from synpick_warp.exporters.formats import find_format
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim.arrange import sample_episodes_ahead
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import Progress

FRAMES_OF_MODE = {Mode.PICK: (60, 44, 102), Mode.TARGET: (81, 51, 75), Mode.MOVE: (409, 0, 33), Mode.STILL: (1, 0, 0)}
"""Frames of an episode: fixed part, part per object, and standard deviation. Least squares over 56 episodes of real objects
(tools/results/episodes_lengths.json)."""
DEVIATIONS = 2.0
"""Standard deviations above the mean by which episodes are ordered, so that those that may become long start early, too.
In a Monte Carlo of 150 mixed episodes in 100 worlds a bake is 1 % faster than in the order of the means."""

SORTED_EPISODES = 1024
"""Number of episodes at the end of the list that are sorted: two rounds of MAX_GPU_WORLDS. Before them modes stay mixed, which keeps
progress and load even."""


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


GB = 10**9
SAMPLED = 1024
"""Maximum number of episodes whose objects are drawn for the forecast; the others have their mean."""
FULL_HD, SIZE_EXPONENT = 1920 * 1080, 0.55
"""Files grow with this power of the pixels [px]: 26 kB were measured at 96x54, 109 kB at 320x180."""
SURE = 0.2
"""A bake is refused if even this fraction of its forecast size is not free: lengths of episodes and sizes of files vary by less."""
VIEW_TIME = (0.9e-3, 0.15e-9)
"""Time of a view in a bake of many worlds on an H100 with 16 cores: fixed part [s] and part per pixel [s/px] (tools/README.md)."""

SETTLE_TIME = 13e-3
"""Time of a pile in 512 worlds that settle: 52 ticks, as 24 piles took on average, of 33 steps, 130,700 a second (tools/README.md) [s]."""


@dataclass(frozen=True)
class Forecast:
    """Expected size of a bake."""

    episodes: int
    frames: int
    views: int
    size: int
    """Size of the data set [B]."""
    gpu_seconds: float
    """Duration on an H100, without start [s]."""

    @property
    def frames_of_episode(self) -> float:
        """Mean number of frames of an episode."""
        return self.frames / max(1, self.episodes)


def forecast_bake(config: Config, catalog: Catalog, episodes: Sequence[int]) -> Forecast:
    """Forecast the bake of these episodes, of which up to SAMPLED are drawn ahead."""
    frames = round(predict_length(config, catalog, episodes[:: len(episodes) // SAMPLED + 1]) * len(episodes))
    # Of each camera: views a frame, and pixels of a view.
    cameras = [(1.0 / every, width * height) for (width, height), every in zip(config.rig.sizes, config.rig.every, strict=True)]
    formats = [find_format(name) for name in config.bake.formats]
    view, tick = sum(each.view_bytes for each in formats), sum(each.frame_bytes for each in formats)
    size = frames * (tick + view * sum(share * (pixels / FULL_HD) ** SIZE_EXPONENT for share, pixels in cameras))
    seconds = SETTLE_TIME * len(episodes) if config.rig.still else 0.0
    seconds += frames * sum(share * (VIEW_TIME[0] + VIEW_TIME[1] * pixels) for share, pixels in cameras)
    return Forecast(len(episodes), frames, round(frames * sum(share for share, _ in cameras)), round(size), seconds)


def predict_length(config: Config, catalog: Catalog, episodes: Sequence[int]) -> float:
    """Predict the mean number of frames per episode from its mode and its number of objects; 0 if there are no episodes."""
    if not len(episodes):
        return 0.0
    modes, objects = sample_episodes_ahead(config, catalog, np.asarray(episodes, np.int32), pick_device(config.bake.device))
    stirring = config.move.rounds / Move().rounds * Move().speed / config.move.speed
    frames = predict_frames(modes, objects) * np.where(modes == Mode.MOVE, stirring, 1.0)
    return float(frames.mean()) * (1.0 if config.rig.still else Physics().tick_time / config.physics.tick_time)


def forecast_settings(config: Config, episodes: Sequence[int], progress: Progress) -> Forecast:
    """Forecast the bake of these episodes; reads the objects of the settings."""
    progress.stage("reading objects")
    return forecast_bake(config, load_catalog(config, report=progress.note), episodes)


def check_disk(forecast: Forecast, folder: Path, progress: Progress) -> None:
    """Compare the forecast size with the free space of a folder's file system, and report if it may not suffice; raises OutputError if it
    certainly does not."""
    free = shutil.disk_usage(folder).free
    if forecast.size <= free:
        return
    words = (
        f"{forecast.episodes:,} episodes of some {forecast.frames_of_episode:.0f} frames take about {forecast.size / GB:,.1f} GB, "
        f"and {folder} has {free / GB:,.1f} GB free"
    )
    if SURE * forecast.size > free:
        raise OutputError(f"{words}; lower bake.episodes or cameras.resolution, set bop.masks = false, or name another --out")
    progress.note(f"{words}: the disk may run full; a bake that stopped there resumes once there is space")
