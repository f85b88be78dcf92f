"""Parts that bake to the temporary folder (TMPDIR): the steady state, with and without pictures.

Counts and resources are sampled after each tick while nearly all worlds are active; then the bake is stopped.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import warp as wp

from synpick_warp.cli.commands.doctor import GIB
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.registry import Exporters
from synpick_warp.factory.forecast import predict_frames
from synpick_warp.factory.memory_plan import pick_processes
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.stages.sim.arrange import sample_episodes_ahead
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from synpick_warp.views.frames import TickBatch
from tools.bench.cleaning import Cleaner, Tally, clean_up_behind
from tools.bench.run import LIVE_FRACTION, SPARE_EPISODES, Bench
from tools.options import MeasuredRow

LEAD_TICKS = 2
"""Warm-up: ticks above LIVE_FRACTION before the measurement, which fill the writers' queues."""
SLICE_SECONDS = 20.0
"""Window length of the reported rates (median, minimum and maximum over windows) [s]."""
WITHOUT_PICTURES = ("usd", "zarr")
"""Formats of trajectories alone; worlds that pick still render the images of their perception."""
HOUR = 3600.0
"""[s]"""
_PARENT, _USER, _SYSTEM, _RESIDENT = 1, 11, 12, 21
"""Indices in /proc/PID/stat (proc_pid_stat(5)) after the command's name: parent process, CPU time in user mode and in system mode [clock
ticks], resident memory [pages]."""
_ANONYMOUS = re.compile(r"^RssAnon:\s*(\d+) kB$", re.MULTILINE)
"""Line of /proc/PID/status, which processes that have ended and kernel threads lack."""


class Usage(NamedTuple):
    """Resources of processes."""

    cpu: float = 0.0
    """CPU time in user mode and in the kernel [s]."""
    resident: int = 0
    """Resident memory [bytes]; memory that processes share, such as the slots through which writers get images, counts in each."""
    anonymous: int = 0
    """Resident memory of the process's own [bytes]: without shared memory and files."""

    def plus(self, other: Usage) -> Usage:
        """Sum of the resources of two."""
        return Usage(self.cpu + other.cpu, self.resident + other.resident, self.anonymous + other.anonymous)


def measure_usage() -> dict[int, Usage]:
    """Resources of this process and of its running descendants, by process id."""
    usages: dict[int, Usage] = {}
    parents: dict[int, int] = {}
    tick = 1.0 / os.sysconf("SC_CLK_TCK")
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                values = list(map(int, (entry / "stat").read_text().rpartition(")")[2].split()[1:]))
                anonymous = _ANONYMOUS.search((entry / "status").read_text())
            except OSError:
                continue
            user, system, pages = (values[index - 1] for index in (_USER, _SYSTEM, _RESIDENT))
            own = 1024 * int(anonymous[1]) if anonymous else 0
            usages[int(entry.name)] = Usage(tick * (user + system), pages * os.sysconf("SC_PAGE_SIZE"), own)
            parents[int(entry.name)] = values[_PARENT - 1]
    ours = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in ours} - ours:
        ours |= more
    return {pid: usages[pid] for pid in ours}


@dataclass(frozen=True)
class Reading:
    """Reading of a bake after a tick."""

    time: float
    """[s]"""
    count: int
    """Views, or frames of worlds, so far."""
    episodes: int
    main: Usage
    """Of the main process."""
    writers: Usage
    """Of the writers; with several devices, of the devices' processes as well."""
    cleaner: Usage
    """Of the processes that verify and delete."""
    tally: Tally
    """Their totals."""
    disk: int
    """Bytes in use on the file system."""
    device: int
    """Bytes of device memory in use, by all processes; 0 on the CPU."""


@dataclass(eq=False)
class SteadyMeter(SilentProgress):
    """Progress observer that takes a reading after each tick of the steady state, and then stops the bake by SIGINT.

    It stops after `seconds` of readings, when no episode waits for a world any more, or when verification finds a damaged file.
    """

    seconds: float
    """Time to measure [s]."""
    folder: Path
    """Where the bake writes."""
    steady_count: float
    """Steady-state threshold: views, or frames, of a device's tick."""
    worlds: int
    """Worlds of a device."""
    device: wp.Device
    """First device of the bake."""
    cleaner: Cleaner | None = None
    """Processes that verify and delete; None: there are none."""
    counter: Callable[[], int] | None = None
    """Function that returns the number of frames so far; None: views are counted."""
    devices: int = 1
    """Devices of the bake, with a process each if there are several."""
    ticks: int = 0
    first_count: float = 0.0
    """Time to the first view or frame [s]."""
    readings: list[Reading] = field(default_factory=list)
    is_stopped: bool = False

    def __post_init__(self) -> None:
        self._counts = deque([0], maxlen=self.devices)
        # Devices with processes of their own leave this one without a CUDA context; each query of free memory would make one, for seconds.
        _ = self.device.context
        self.started, self.initial_disk = time.perf_counter(), shutil.disk_usage(self.folder).used

    def update(self, *, episodes_done: int, episodes: int, views: int, **_: Any) -> None:
        """Take a reading after each tick from the steady state on; interrupts the bake when it has measured long enough."""
        count = self.counter() if self.counter else views
        tally = self.cleaner.poll() if self.cleaner else Tally()
        if count:
            self.first_count = self.first_count or time.perf_counter() - self.started
            # Ticks of several devices take turns: as many of them as there are devices are counted together.
            self.ticks += int(self.ticks > 0 or count - self._counts[0] >= self.devices * self.steady_count)
            self._counts.append(count)
            if self.ticks > LEAD_TICKS * self.devices and not self.is_stopped:
                self.readings.append(self._read(count, episodes_done, tally))
        measured = len(self.readings) > 1 and self.readings[-1].time - self.readings[0].time >= self.seconds
        if not self.is_stopped and (measured or tally.problem or episodes_done >= episodes - self.worlds * self.devices):
            self.is_stopped = True
            os.kill(os.getpid(), signal.SIGINT)

    def _read(self, count: int, episodes: int, tally: Tally) -> Reading:
        """Reading of this moment: time, counts, CPU and memory of the processes, cleaner apart, disk, device memory."""
        now, disk, usages = time.perf_counter(), shutil.disk_usage(self.folder).used, measure_usage()
        main, pids = usages.pop(os.getpid(), Usage()), self.cleaner.pids if self.cleaner else ()
        cleaner = reduce(Usage.plus, [usages.pop(pid, Usage()) for pid in pids], Usage())
        device = self.device.total_memory - self.device.free_memory if self.device.is_cuda else 0
        return Reading(now, count, episodes, main, reduce(Usage.plus, usages.values(), Usage()), cleaner, tally, disk, device)


def slice_rates(readings: Sequence[Reading], seconds: float) -> list[float]:
    """Counts per second of consecutive slices of at least `seconds` [s], which begin and end with readings; the rest is left out."""
    rates: list[float] = []
    first = readings[0]
    for reading in readings[1:]:
        if reading.time - first.time >= seconds:
            rates.append((reading.count - first.count) / (reading.time - first.time))
            first = reading
    return rates


def summarize_rates(unit: str, meter: SteadyMeter) -> Iterator[MeasuredRow]:
    """Rows of a measurement with at least two readings: rate, its slices, CPU time, and memory at both ends; `unit` is what they count."""
    first, last = meter.readings[0], meter.readings[-1]
    count, seconds = last.count - first.count, last.time - first.time
    yield MeasuredRow(f"time to the first {unit}s", meter.first_count, "s")
    yield MeasuredRow("measured", seconds, "s")
    yield MeasuredRow("a tick", 1e3 * meter.devices * seconds / (len(meter.readings) - 1), "ms")
    yield MeasuredRow(f"{unit}s to disk", count / seconds, "1/s")
    rates = slice_rates(meter.readings, SLICE_SECONDS)
    for name, choose in ((f"median of {len(rates)} times", statistics.median), ("slowest", min), ("fastest", max)) if rates else ():
        yield MeasuredRow(f"{unit}s to disk, {name} {SLICE_SECONDS:.0f} s", choose(rates), "1/s")
    workers = "writers" if meter.devices == 1 else "writers and devices' processes"
    spent = {workers: last.writers.cpu - first.writers.cpu, "main process": last.main.cpu - first.main.cpu}
    if meter.cleaner:
        spent["verification and deletion"] = last.cleaner.cpu - first.cleaner.cpu
    for name, value in spent.items():
        yield MeasuredRow(f"CPU time of a {unit}, {name}", 1e3 * value / max(1, count), "ms")
    yield MeasuredRow("cores busy", sum(spent.values()) / seconds, "")
    for when, reading in (("at the beginning", first), ("at the end", last)):
        yield MeasuredRow(f"resident memory of the main process, {when}", reading.main.resident / GIB, "GiB")
        yield MeasuredRow(f"resident memory of all {workers}, shared memory in each, {when}", reading.writers.resident / GIB, "GiB")
        yield MeasuredRow(f"memory of all {workers} without shared memory, {when}", reading.writers.anonymous / GIB, "GiB")
    if meter.device.is_cuda:
        yield MeasuredRow("device memory in use by all processes, first device", last.device / GIB, "GiB")
    yield MeasuredRow("episodes that ended", last.episodes - first.episodes, "")


# ---- parts ----


def _rows_of(meter: SteadyMeter, stopped: int, rows: Iterator[MeasuredRow]) -> Iterator[MeasuredRow]:
    """Yield the rows of a bake, if there are readings; raises KeyboardInterrupt if Ctrl-C or another signal from outside stopped it."""
    if len(meter.readings) > 1:
        yield from rows
    if stopped and not meter.is_stopped:
        raise KeyboardInterrupt


def measure_steady(bench: Bench) -> Iterator[MeasuredRow]:
    """Views per second to disk while nearly all worlds live, and CPU time of a view by kind of process, of `bake.worlds` a device."""
    config = bench.config
    names = pick_processes(config, bench.devices, INT32_MAX) if bench.devices else ()
    count = max(1, len(names))
    config = config.with_values({"bake.episodes": SPARE_EPISODES * config.bake.worlds * count})
    device = pick_device(names[0] if names else config.bake.device)
    live_views = LIVE_FRACTION * config.bake.worlds * len(config.rig)
    with tempfile.TemporaryDirectory() as folder, clean_up_behind(DataLayout.of(config), Path(folder) / "out") as cleaner:
        meter = SteadyMeter(bench.seconds, Path(folder), live_views, config.bake.worlds, device, cleaner, devices=count)
        summary = run_bake(config, Path(folder) / "out", meter, devices=names)
    yield from _rows_of(meter, summary.stopped, _summarize_steady(meter))


def _summarize_steady(meter: SteadyMeter) -> Iterator[MeasuredRow]:
    """Rows of the rates, the verified scenes, and the space on disk."""
    yield from summarize_rates("view", meter)
    first, last = meter.readings[0], meter.readings[-1]
    verified, deleted = last.tally.episodes - first.tally.episodes, last.tally.deleted - first.tally.deleted
    yield MeasuredRow("episodes of which all files are verified and deleted", verified, "")
    yield MeasuredRow("files of these", last.tally.files - first.tally.files, "")
    yield MeasuredRow("errors found in them", int(bool(last.tally.problem)), "")
    yield MeasuredRow("size of a view on disk", 1e-6 * (last.disk + deleted - first.disk) / max(1, last.count - first.count), "MB")
    # Others may delete files of the same file system meanwhile.
    disk = max(meter.initial_disk, *(reading.disk for reading in meter.readings))
    yield MeasuredRow("largest size on disk", 1e-9 * (disk - meter.initial_disk), "GB")


def measure_trajectories(bench: Bench) -> Iterator[MeasuredRow]:
    """World-steps per second and episodes per hour of a bake without pictures in steady state."""
    config = bench.config.with_values({"bake.formats": WITHOUT_PICTURES, "bake.episodes": SPARE_EPISODES * bench.config.bake.worlds})
    worlds, frames, write = config.bake.worlds, [0], Exporters.write_ticks

    def count(exporters: Exporters, batch: TickBatch) -> None:
        frames[0] += len(batch)
        write(exporters, batch)

    with tempfile.TemporaryDirectory() as folder, mock.patch.object(Exporters, "write_ticks", count):
        meter = SteadyMeter(bench.seconds, Path(folder), LIVE_FRACTION * worlds, worlds, bench.device, counter=lambda: frames[0])
        summary = run_bake(config, Path(folder) / "out", meter)
    yield from _rows_of(meter, summary.stopped, _summarize_trajectories(config, meter))


def _summarize_trajectories(config: Config, meter: SteadyMeter) -> Iterator[MeasuredRow]:
    """Rows: rates, world-steps of all worlds whether live or not, disk space, and episodes, by the mean of their predicted frames."""
    worlds, physics = config.bake.worlds, config.physics
    yield MeasuredRow("worlds", worlds, "")
    yield from summarize_rates("frame", meter)
    first, last = meter.readings[0], meter.readings[-1]
    seconds, ticks, frames = last.time - first.time, len(meter.readings) - 1, last.count - first.count
    rate = ticks * physics.steps_per_tick * worlds / seconds
    yield MeasuredRow("world-steps", rate, "1/s")
    yield MeasuredRow("simulated time: multiple of real time", rate * physics.step, "")
    yield MeasuredRow("worlds with a frame in a tick", 100.0 * frames / (ticks * worlds), "%")
    yield MeasuredRow("size of a frame on disk", 1e-3 * (last.disk - first.disk) / max(1, frames), "kB")
    episodes = np.arange(config.bake.episodes, dtype=np.int32)
    mean = float(np.mean(predict_frames(*sample_episodes_ahead(config, load_catalog(config), episodes, meter.device))))
    yield MeasuredRow(f"episodes, if of {mean:.0f} frames as in tools/README.md", HOUR * frames / seconds / mean, "1/h")
