"""Benchmark of a bake's steady state: views per second to disk while all worlds act, and CPU time of a view by kind of process."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from synpick_warp.configs.schema import Config
from synpick_warp.pipeline import run_bake
from synpick_warp.progress import SilentProgress
from tools.bench.physics import Row

LIVE_FRACTION = 0.9
"""Steady-state threshold: fraction of the worlds that must deliver views in a tick. Before, worlds settle, and physics has a larger
part."""
LEAD_TICKS = 2
"""Warm-up: ticks above LIVE_FRACTION before the measurement, which fill the writers' queues."""
SPARE_EPISODES = 2
"""Episodes planned for each world, so that none runs out of them in the measurement."""
PARENT_FIELD, USER_FIELD, SYSTEM_FIELD = 1, 11, 12
"""Indices in /proc/PID/stat after the command's name: parent process, CPU time in user mode and in system mode [clock ticks]."""


@dataclass(frozen=True)
class _Reading:
    """State of a bake after a tick."""

    time: float
    """[s]"""
    views: int
    main: float
    """CPU time of the main process [s]."""
    writers: float
    """CPU time of its child processes, the writers [s]."""
    disk: int
    """Bytes in use on the file system."""


class _Meter(SilentProgress):
    """Progress observer that takes readings, and stops the bake by a signal, as a user would, when `seconds` are measured."""

    def __init__(self, seconds: float, folder: Path, live_views: float) -> None:
        """
        Args:
            seconds: Time to measure [s].
            folder: Where the bake writes.
            live_views: Views of a tick from which it counts as steady.
        """
        self.seconds, self.folder, self.live_views = seconds, folder, live_views
        self.ticks, self.last_views = 0, 0
        self.started = time.perf_counter()
        self.first_view = 0.0
        self.readings: list[_Reading] = []

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Take a reading after each tick of the measurement."""
        if not views:
            return
        self.first_view = self.first_view or time.perf_counter() - self.started
        self.ticks += int(self.ticks > 0 or views - self.last_views >= self.live_views)
        self.last_views = views
        if self.ticks <= LEAD_TICKS or (len(self.readings) > 1 and self._measured() >= self.seconds):
            return
        used = shutil.disk_usage(self.folder).used
        self.readings.append(_Reading(time.perf_counter(), views, time.process_time(), _writers_cpu_time(), used))
        if len(self.readings) > 1 and self._measured() >= self.seconds:
            os.kill(os.getpid(), signal.SIGINT)

    def _measured(self) -> float:
        return self.readings[-1].time - self.readings[0].time


def _writers_cpu_time() -> float:
    """CPU time of all running child processes [s]."""
    total = 0
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                values = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(values[PARENT_FIELD]) == os.getpid():
                total += int(values[USER_FIELD]) + int(values[SYSTEM_FIELD])
    return total / os.sysconf("SC_CLK_TCK")


def measure_steady(config: Config, min_seconds: float) -> Iterator[Row]:
    """Bake to the temporary folder (TMPDIR) until `min_seconds` [s] with views are measured; what was written is removed."""
    config = dataclasses.replace(config, bake=dataclasses.replace(config.bake, episodes=SPARE_EPISODES * config.bake.worlds))
    live_views = LIVE_FRACTION * config.bake.worlds * len(config.cameras.positions)
    with tempfile.TemporaryDirectory() as folder:
        meter = _Meter(min_seconds, Path(folder), live_views)
        run_bake(config, Path(folder) / "out", meter)
    yield from _summarize(meter)


def _summarize(meter: _Meter) -> Iterator[Row]:
    """Rows of a measurement; none if it was too short."""
    if len(meter.readings) < 2:
        return
    first, last = meter.readings[0], meter.readings[-1]
    views, seconds = last.views - first.views, last.time - first.time
    main, writers = last.main - first.main, last.writers - first.writers
    yield Row("steady", "time to the first views", meter.first_view, "s")
    yield Row("steady", "measured", seconds, "s")
    yield Row("steady", "a tick", 1e3 * seconds / (len(meter.readings) - 1), "ms")
    yield Row("steady", "views to disk", views / seconds, "1/s")
    yield Row("steady", "CPU time of a view, writers", 1e3 * writers / views, "ms")
    yield Row("steady", "CPU time of a view, main process", 1e3 * main / views, "ms")
    yield Row("steady", "cores busy", (main + writers) / seconds, "")
    yield Row("steady", "size of a view on disk", 1e-6 * (last.disk - first.disk) / views, "MB")
