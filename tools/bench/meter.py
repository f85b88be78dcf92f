"""Meter of a bake's steady state: readings of counts and resources after each tick while nearly all worlds act, and a stop at the end."""

from __future__ import annotations

import os
import re
import shutil
import signal
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import warp as wp

from synpick_warp.cli.commands.doctor import GIB
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.system.progress import SilentProgress
from tools.bench.cleaner import Cleaner, Tally
from tools.options import MeasuredRow

LEAD_TICKS = 2
"""Warm-up: ticks above LIVE_FRACTION before the measurement, which fill the writers' queues."""
SLICE_SECONDS = 20.0
"""Window length of the reported rates (median, minimum and maximum over windows) [s]."""
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
    return {pid: usage for pid, usage in usages.items() if _descends(pid, os.getpid(), parents)}


def _descends(pid: int, ancestor: int, parents: dict[int, int]) -> bool:
    """True if a process is the ancestor or one of its descendants."""
    while pid in parents and pid != ancestor:
        pid = parents[pid]
    return pid == ancestor


@dataclass(frozen=True)
class Reading:
    """Reading of a bake after a tick."""

    time: float
    """[s]"""
    count: int
    """Views, or frames of worlds, so far."""
    episodes: int
    """Ended episodes."""
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


class SteadyMeter(SilentProgress):
    """Progress observer that takes a reading after each tick of the steady state, and then stops the bake by SIGINT.

    It stops after `seconds` of readings, when no episode waits for a world any more, or when verification finds a damaged file.
    """

    def __init__(
        self,
        seconds: float,
        folder: Path,
        steady_count: float,
        worlds: int,
        device: wp.Device,
        cleaner: Cleaner | None = None,
        counter: Callable[[], int] | None = None,
        devices: int = 1,
    ) -> None:
        """
        Args:
            seconds: Time to measure [s].
            folder: Where the bake writes.
            steady_count: Steady-state threshold: views, or frames, of a device's tick.
            worlds: Worlds of a device.
            device: First device of the bake.
            cleaner: Processes that verify and delete; None: there are none.
            counter: Function that returns the number of frames so far; None: views are counted.
            devices: Devices of the bake, with a process each if there are several.
        """
        self.seconds, self.folder, self.steady_count, self.worlds = seconds, folder, steady_count, worlds
        self.device, self.cleaner, self.counter, self.devices = device, cleaner, counter, devices
        self.ticks = 0
        self._counts = deque([0], maxlen=devices)
        # Devices with processes of their own leave this one without a CUDA context; each query of free memory would make one, for seconds.
        _ = device.context
        self.started = time.perf_counter()
        self.first_count = 0.0
        self.initial_disk = shutil.disk_usage(folder).used
        self.readings: list[Reading] = []
        self.is_stopped = False

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

    def raise_interruption(self, summary: BakeSummary) -> None:
        """Raise KeyboardInterrupt if Ctrl-C or another signal from outside stopped the bake."""
        if summary.stopped and not self.is_stopped:
            raise KeyboardInterrupt

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
