"""Parts that bake to the temporary folder (TMPDIR): the steady state, with and without pictures, and whole bakes from start to exit.

Background processes verify finished episodes and delete their files, so that the disk does not fill: in a steady state all files, in a
whole bake the images alone, because it reads some of the others at its end.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import committed_episodes
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.registry import Exporters, load_exporter_classes, shared_files
from synpick_warp.factory.order import predict_frames
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.factory.sizes import pick_processes
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.stages.sim.arrange import sample_episodes_ahead
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from synpick_warp.views.frames import TickBatch
from tools.bench.cleaner import Assignment, Cleaner
from tools.bench.meter import SteadyMeter, summarize_rates
from tools.bench.run import LIVE_FRACTION, SPARE_EPISODES, Bench
from tools.options import Row

PICTURES = (".jpg", ".png")
"""Suffixes of the images, of which a hundred episodes of full-HD views have some 100 GB."""
WITHOUT_PICTURES = ("usd", "zarr")
"""Formats of trajectories alone; worlds that pick still render the images of their perception."""
HOUR = 3600.0
"""[s]"""


@contextlib.contextmanager
def clean_up_behind(layout: DataLayout, out: Path, suffixes: tuple[str, ...] = ()) -> Iterator[Cleaner]:
    """Context manager: verify the episodes of a bake to `out` while it runs, and delete their files with these suffixes (empty: all).

    Raises:
        DatasetError: An episode was damaged.
    """
    folders = tuple(map(str, shared_files(load_exporter_classes(layout.formats), layout).folders))
    with Cleaner(Assignment(out, folders, suffixes)) as cleaner:
        yield cleaner
        tally = cleaner.poll()
    if tally.problem:
        raise DatasetError(tally.problem)


# ---- steady state ----


def measure_steady(bench: Bench) -> Iterator[Row]:
    """Views per second to disk while nearly all worlds are live, and CPU time of a view by kind of process; each device simulates
    `bake.worlds` worlds."""
    config = bench.config
    names = pick_processes(config, bench.devices, INT32_MAX) if bench.devices else ()
    count = max(1, len(names))
    config = config.with_values({"bake.episodes": SPARE_EPISODES * config.bake.worlds * count})
    device = pick_device(names[0] if names else config.bake.device)
    live_views = LIVE_FRACTION * config.bake.worlds * len(config.rig)
    with tempfile.TemporaryDirectory() as folder, clean_up_behind(DataLayout.of(config), Path(folder) / "out") as cleaner:
        meter = SteadyMeter(bench.seconds, Path(folder), live_views, config.bake.worlds, device, cleaner, devices=count)
        summary = run_bake(config, Path(folder) / "out", meter, devices=names)
    if len(meter.readings) > 1:
        yield from _summarize_steady(meter)
    meter.raise_interruption(summary)


def _summarize_steady(meter: SteadyMeter) -> Iterator[Row]:
    """Rows of the rates, the verified scenes, and the space on disk."""
    yield from summarize_rates("view", meter)
    first, last = meter.readings[0], meter.readings[-1]
    verified, deleted = last.tally.episodes - first.tally.episodes, last.tally.deleted - first.tally.deleted
    yield Row("episodes that ended", last.episodes - first.episodes, "")
    yield Row("episodes of which all files are verified and deleted", verified, "")
    yield Row("files of these", last.tally.files - first.tally.files, "")
    yield Row("errors found in them", int(bool(last.tally.problem)), "")
    yield Row("size of a view on disk", 1e-6 * (last.disk + deleted - first.disk) / max(1, last.count - first.count), "MB")
    # Others may delete files of the same file system meanwhile.
    disk = max(meter.initial_disk, *(reading.disk for reading in meter.readings))
    yield Row("largest size on disk", 1e-9 * (disk - meter.initial_disk), "GB")


def measure_trajectories(bench: Bench) -> Iterator[Row]:
    """World-steps per second and episodes per hour of a bake without pictures in steady state."""
    config = bench.config.with_values({"bake.formats": WITHOUT_PICTURES, "bake.episodes": SPARE_EPISODES * bench.config.bake.worlds})
    worlds = config.bake.worlds
    with tempfile.TemporaryDirectory() as folder, _count_frames() as frames:
        meter = SteadyMeter(bench.seconds, Path(folder), LIVE_FRACTION * worlds, worlds, bench.device, counter=lambda: frames[0])
        summary = run_bake(config, Path(folder) / "out", meter)
    if len(meter.readings) > 1:
        sampled = sample_episodes_ahead(config, load_catalog(config), np.arange(config.bake.episodes, dtype=np.int32), bench.device)
        yield from _summarize_trajectories(config, float(np.mean(predict_frames(*sampled))), meter)
    meter.raise_interruption(summary)


@contextlib.contextmanager
def _count_frames() -> Iterator[list[int]]:
    """Count frames handed to the exporters within this context; yields a list whose one element is the count."""
    frames, write = [0], Exporters.write_ticks

    def count(exporters: Exporters, batch: TickBatch) -> None:
        frames[0] += len(batch)
        write(exporters, batch)

    with mock.patch.object(Exporters, "write_ticks", count):
        yield frames


def _summarize_trajectories(config: Config, mean: float, meter: SteadyMeter) -> Iterator[Row]:
    """Rows: rates, world-steps of all worlds whether live or not, disk space, and episodes, which have `mean` frames."""
    worlds, physics = config.bake.worlds, config.physics
    yield Row("worlds", worlds, "")
    yield from summarize_rates("frame", meter)
    first, last = meter.readings[0], meter.readings[-1]
    seconds, ticks, frames = last.time - first.time, len(meter.readings) - 1, last.count - first.count
    rate = ticks * physics.steps_per_tick * worlds / seconds
    yield Row("world-steps", rate, "1/s")
    yield Row("simulated time: multiple of real time", rate * physics.step, "")
    yield Row("worlds with a frame in a tick", 100.0 * frames / (ticks * worlds), "%")
    yield Row("size of a frame on disk", 1e-3 * (last.disk - first.disk) / max(1, frames), "kB")
    yield Row("episodes that ended", last.episodes - first.episodes, "")
    yield Row(f"episodes, if of {mean:.0f} frames as in tools/README.md", HOUR * frames / seconds / mean, "1/h")


# ---- whole bakes ----


class TracePoint(NamedTuple):
    """State of a bake after a tick."""

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


TITLES = {
    "start": "start to the first views",
    "settling": "from there to {} live",
    "steady": "ticks with {} live",
    "between": "ticks between these with fewer than {} live",
    "tail": "tail: after the last tick with {} live",
    "finishing": "finishing: last files, indices",
}
"""Stretches of a bake, and their names in the report."""


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

    def update(self, *, episodes_done: int, worlds_active: int, views: int, **others: Any) -> None:
        """Record a point of progress and the disk used; interrupts the bake if the cleaner has a problem."""
        if self.cleaner.poll().problem and not self._is_stopped:
            self._is_stopped = True
            os.kill(os.getpid(), signal.SIGINT)
        self.disk = max(self.disk, shutil.disk_usage(self.folder).used - self._initial_disk)
        self.points.append(TracePoint(time.perf_counter() - self.started, views, worlds_active, episodes_done))


def measure_whole(bench: Bench) -> Iterator[Row]:
    """Mean rate of a bake from start to exit, with default batches and writers, and where the time goes."""
    config = bench.config.with_values({"bake.episodes": bench.episodes, "bake.worlds": bench.worlds})
    with tempfile.TemporaryDirectory() as folder, clean_up_behind(DataLayout.of(config), Path(folder) / "out", PICTURES) as cleaner:
        trace = _Trace(Path(folder), cleaner)
        summary = run_bake(config, Path(folder) / "out", trace)
        whole = Stretch(time.perf_counter() - trace.started, summary.views)
        tally = cleaner.finish(len(committed_episodes(Path(folder) / "out")))
        verified = time.perf_counter() - trace.started
    cameras = len(config.rig)
    bench.traces["whole"] = describe_trace(trace.points, cameras)
    yield from summarize_whole(trace.points, cameras, whole, bench.values.get("views to disk", 0.0))
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
    number of active worlds are live; without such ticks, all from the first views on are settling."""
    live = count_live(points, cameras)
    threshold = LIVE_FRACTION * max((point.active for point in points), default=0)
    steady = [index for index, count in enumerate(live) if count and count >= threshold]
    first, last = (steady[0], steady[-1]) if steady else (len(points), len(points))
    stretches: dict[str, Stretch] = dict.fromkeys(TITLES, Stretch())
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


def summarize_whole(points: Sequence[TracePoint], cameras: int, whole: Stretch, steady_rate: float) -> Iterator[Row]:
    """Rows of a whole bake: counts, times and rates; `steady_rate`: views per second of the part steady, 0: not measured."""
    stretches, mean = split_stretches(points, cameras, whole), whole.views / whole.seconds
    yield Row("worlds", max((point.active for point in points), default=0), "")
    yield Row("ticks", len(points), "")
    yield Row("views", whole.views, "")
    yield Row("start to exit", whole.seconds, "s")
    for name, stretch in stretches.items():
        yield Row(TITLES[name].format(f"{100 * LIVE_FRACTION:.0f} % of worlds"), stretch.seconds, "s")
        if stretch.views:
            yield Row(f"{name}: views", stretch.views / stretch.seconds, "1/s")
    yield Row("mean of the whole: views", mean, "1/s")
    steady = stretches["steady"]
    if steady.views:
        yield Row("mean, of the rate of its own steady ticks", 100.0 * mean * steady.seconds / steady.views, "%")
    if steady_rate:
        yield Row("mean, of the rate of the part steady", 100.0 * mean / steady_rate, "%")
