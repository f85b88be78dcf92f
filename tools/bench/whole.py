"""Benchmark of a whole bake: its mean rate from start to exit, and where the time goes.

Episodes are verified while the bake runs, and their images deleted, since a hundred episodes of full-HD views take some 100 GB; other files
are kept, because the bake reads some of them at its end.
"""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import committed_episodes
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.system.progress import SilentProgress
from tools.bench.cleaner import Cleaner
from tools.bench.meter import LIVE_FRACTION
from tools.bench.steady import clean_up_behind
from tools.options import Row

PICTURES = (".jpg", ".png")
"""Suffixes of the images, which are deleted once verified."""


class WholeBake(NamedTuple):
    """Size of a bake to measure: episodes, and worlds (0: automatic)."""

    episodes: int
    worlds: int = 0
    """Worlds simulated in parallel; 0: automatic."""


class TracePoint(NamedTuple):
    """State of a bake after a tick: time since the start [s], views, worlds at work, ended episodes."""

    seconds: float
    """Time since the start [s]."""
    views: int
    active: int
    """Worlds that are settling or acting."""
    episodes: int
    """Episodes that have ended."""


class Stretch(NamedTuple):
    """Time [s] and views of one stretch of a bake, such as settling or the tail."""

    seconds: float = 0.0
    views: int = 0

    def plus(self, seconds: float, views: int) -> Stretch:
        """Sum with one more tick."""
        return Stretch(self.seconds + seconds, self.views + views)


class _Trace(SilentProgress):
    """Progress observer that records a point after each tick, when each stage begins, and the largest size on disk after a tick.

    Stops the bake by SIGINT when verification finds a problem.
    """

    def __init__(self, folder: Path, cleaner: Cleaner) -> None:
        self.folder, self.cleaner, self.started, self.disk = folder, cleaner, time.perf_counter(), 0
        self._is_stopped = False
        self._initial_disk = shutil.disk_usage(folder).used
        self.points: list[TracePoint] = []
        self.stages: list[tuple[str, float]] = []

    def stage(self, text: str) -> None:
        """Record when a stage begins."""
        self.stages.append((text, time.perf_counter() - self.started))

    def update(self, *, episodes_done: int, worlds_active: int, views: int, **_: Any) -> None:
        """Record a point of progress and the disk used; interrupts the bake if the cleaner has a problem."""
        if self.cleaner.poll().problem and not self._is_stopped:
            self._is_stopped = True
            os.kill(os.getpid(), signal.SIGINT)
        self.disk = max(self.disk, shutil.disk_usage(self.folder).used - self._initial_disk)
        self.points.append(TracePoint(time.perf_counter() - self.started, views, worlds_active, episodes_done))


def measure_whole(config: Config, bake: WholeBake, steady_rate: float, traces: dict[str, Any]) -> Iterator[Row]:
    """Bake to the temporary folder (TMPDIR), with default batches and writers.

    Args:
        config: All settings.
        bake: Size of the bake.
        steady_rate: Views per second of the benchmark part `steady`, for comparison; 0: not measured.
        traces: Receives the columns of `describe_trace` under the key "whole".
    """
    config = config.with_values({"bake.episodes": bake.episodes, "bake.worlds": bake.worlds})
    with tempfile.TemporaryDirectory() as folder, clean_up_behind(DataLayout.of(config), Path(folder) / "out", PICTURES) as cleaner:
        trace = _Trace(Path(folder), cleaner)
        summary = run_bake(config, Path(folder) / "out", trace)
        whole = Stretch(time.perf_counter() - trace.started, summary.views)
        tally = cleaner.finish(len(committed_episodes(Path(folder) / "out")))
        verified = time.perf_counter() - trace.started
    cameras = len(config.rig)
    traces["whole"] = describe_trace(trace.points, cameras)
    yield from summarize(trace.points, cameras, whole, steady_rate)
    for text, seconds in trace.stages:
        yield Row(f"begin of: {text}", seconds, "s")
    yield Row("episodes of which all files are verified", tally.episodes, "")
    yield Row("files of these", tally.files, "")
    yield Row("start until all episodes are verified, at least until exit", verified, "s")
    yield Row("largest size on disk, after a tick", 1e-9 * trace.disk, "GB")
    if summary.stopped:
        raise KeyboardInterrupt


def count_live(points: Sequence[TracePoint], cameras: int) -> list[int]:
    """Worlds that delivered views in each tick, from the points of progress."""
    frames = [0, *(point.views // cameras for point in points)]
    return [now - before for before, now in itertools.pairwise(frames)]


def describe_trace(points: Sequence[TracePoint], cameras: int) -> dict[str, list[float]]:
    """Columns for JSON: seconds since the start, and after each tick live and active worlds, views and ended episodes."""
    return {
        "seconds": [round(point.seconds, 3) for point in points],
        "live": list(count_live(points, cameras)),
        "active": [point.active for point in points],
        "views": [point.views for point in points],
        "episodes": [point.episodes for point in points],
    }


def split_stretches(points: Sequence[TracePoint], cameras: int, whole: Stretch) -> dict[str, Stretch]:
    """Assign each tick to a stretch of the bake; stretches add up to the whole. A tick is steady if at least LIVE_FRACTION of the largest
    number of active worlds are live; without such ticks, all from the first views on are settling.

    Args:
        points: State after each tick.
        cameras: Number of cameras.
        whole: Time and views of the whole bake.
    """
    live = count_live(points, cameras)
    threshold = LIVE_FRACTION * max((point.active for point in points), default=0)
    steady = [index for index, count in enumerate(live) if count and count >= threshold]
    first, last = (steady[0], steady[-1]) if steady else (len(points), len(points))
    stretches: dict[str, Stretch] = dict.fromkeys(("start", "settling", "steady", "between", "tail", "finishing"), Stretch())
    before = TracePoint(0.0, 0, 0, 0)
    for index, point in enumerate(points):
        if before.views == 0:
            name = "start"
        elif index < first:
            name = "settling"
        elif index > last:
            name = "tail"
        else:
            name = "steady" if live[index] >= threshold else "between"
        stretches[name] = stretches[name].plus(point.seconds - before.seconds, point.views - before.views)
        before = point
    stretches["finishing"] = Stretch(whole.seconds - before.seconds, whole.views - before.views)
    return stretches


def summarize(points: Sequence[TracePoint], cameras: int, whole: Stretch, steady_rate: float) -> Iterator[Row]:
    """Yield the result rows of a whole bake: counts, times and rates. Arguments as in `split_stretches` and `measure_whole`."""
    stretches, mean = split_stretches(points, cameras, whole), whole.views / whole.seconds
    many = f"{100 * LIVE_FRACTION:.0f} % of worlds"
    titles = {
        "start": "start to the first views",
        "settling": f"from there to {many} live",
        "steady": f"ticks with {many} live",
        "between": f"ticks between these with fewer than {many} live",
        "tail": f"tail: after the last tick with {many} live",
        "finishing": "finishing: last files, indices",
    }
    yield Row("worlds", max((point.active for point in points), default=0), "")
    yield Row("ticks", len(points), "")
    yield Row("views", whole.views, "")
    yield Row("start to exit", whole.seconds, "s")
    for name, stretch in stretches.items():
        yield Row(titles[name], stretch.seconds, "s")
        if stretch.views:
            yield Row(f"{name}: views", stretch.views / stretch.seconds, "1/s")
    yield Row("mean of the whole: views", mean, "1/s")
    steady = stretches["steady"]
    if steady.views:
        yield Row("mean, of the rate of its own steady ticks", 100.0 * mean * steady.seconds / steady.views, "%")
    if steady_rate:
        yield Row("mean, of the rate of the part steady", 100.0 * mean / steady_rate, "%")
