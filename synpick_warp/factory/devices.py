"""Processes of a bake on several devices, one each: started early, handed their episodes, watched, stopped, and ended with the bake.

All write into one data set. An episode is committed by its own manifest entry, and its files have names of their own, also in `PARTIAL`,
so that nothing is joined or copied afterwards. This process owns the folder: lock, manifest, constants and indices. It neither touches a
GPU nor simulates, so that a device that fails takes neither the others nor the folder with it.

No process outlives the bake: a device's process ends its writers and itself when its link closes, which the kernel does even if this
process is killed; its writers end when theirs closes.
"""

import contextlib
import os
import pickle
import select
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Self

import warp as wp

from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import committed_episodes
from synpick_warp.dataset.commit.writing import OutputFolder, digest_inputs
from synpick_warp.errors import DeviceError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.registry import Exporters, Needs, aborting
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.episodes import BakeSummary, count_writers
from synpick_warp.factory.forecast import check_disk, deal_episodes, deal_writers, forecast_bake, order_longest_first
from synpick_warp.scenes.build import REPEATS, must_repeat, without_distractors
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.looks import Looks, load_looks
from synpick_warp.scenes.types import Camera, Catalog, EnvironmentMap
from synpick_warp.stages.render.layers import with_suctionable_area
from synpick_warp.stages.render.looks import load_scene_lights
from synpick_warp.system.hardware.device import describe_kinds, pick_device
from synpick_warp.system.hardware.kernels import KERNEL_VARIABLE
from synpick_warp.system.interpreter import duplicate_above_streams, open_standard_descriptors
from synpick_warp.system.processes.interrupt import StopRequest
from synpick_warp.system.processes.pool import END_TIMEOUT, WorkerProcess, send, start_process
from synpick_warp.system.progress import Progress

_INTERVAL = 0.1
"""Polling interval of the stop request, at most [s]."""
_NONE = {"episodes_done": 0, "worlds_active": 0, "views": 0, "views_per_s": 0.0, "seconds_left": None}


@dataclass(frozen=True)
class DeviceShare:
    """Part of a bake that a device's process receives first: output folder, settings, episodes in the order of their start."""

    out: Path
    config: Config
    """Settings with the process's device and writers."""
    episodes: list[int]
    processes: int
    """Processes of the bake, which share the host's memory."""


@dataclass(eq=False)
class _Device:
    """Device's process, with its last counts and fault (empty: none). Everything that it sends is a pair: kind of message, content."""

    name: str
    worker: WorkerProcess
    lifeline: int
    """Read end of a pipe whose other end the process and its writers hold: it closes when the last of them has ended."""
    counts: dict[str, Any] = field(default_factory=lambda: dict(_NONE))
    """Last counts, as for `Progress.update`."""
    running: bool = True
    fault: str = ""
    """Why the process ended before its episodes."""


class DeviceProcesses:
    """Processes of a bake, one per device; a context manager at whose end none of them, and none of their writers, runs any more."""

    def __init__(self, names: Sequence[str], program: str, lock: int) -> None:
        """Start the processes, which load their libraries while this one prepares the folder. `program` is Python code that calls
        `worker.main`, `lock` the handle of the folder's lock; all keep it open. Raises DeviceError if processes cannot be started."""
        open_standard_descriptors()
        self._devices: list[_Device] = []
        self._reported: set[tuple[str, str]] = set()
        try:
            for name in names:
                self._devices.append(_start(name, program, lock))
        except OSError as error:
            self._end()
            raise DeviceError(f"cannot start {len(names)} processes: {error.strerror}; name fewer devices") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def report_once(self, progress: Progress, kind: str, text: str) -> None:
        """Report a "stage" or a "note"; all processes, and this one, have the same stages, and the same notes about objects."""
        if (kind, text) not in self._reported:
            self._reported.add((kind, text))
            getattr(progress, kind)(text)

    def run(self, shares: Sequence[Any], summary: BakeSummary, progress: Progress) -> str:
        """Hand out the shares, a `DeviceShare` each or what their program takes, and wait until all processes have ended; if a device is
        lost, the others go on.

        `summary` receives the processes' summaries; its `resumed` episodes count as done. Returns which devices were lost, and why; empty:
        none. Raises the SynpickError of a process; the others are ended."""
        for device, share in zip(self._devices, shares, strict=True):
            with contextlib.suppress(OSError):  # It has died; its link says so below.
                send(device.worker.link, share)
        asked = False
        with StopRequest() as stop:
            while running := [device for device in self._devices if device.running]:
                if not asked and (stop.number or summary.stopped):
                    asked = True
                    for device in running:
                        with contextlib.suppress(OSError):
                            send(device.worker.link, stop.number or summary.stopped)
                ready = wait([device.worker.link for device in running], _INTERVAL)
                for device in running:
                    if device.worker.link in ready:
                        self._receive(device, summary, progress)
        lost = [device for device in self._devices if device.fault]
        return f"lost {' and '.join(device.name for device in lost)}: {lost[0].fault}" if lost else ""

    def _receive(self, device: _Device, summary: BakeSummary, progress: Progress) -> None:
        """Receive one message of a device's process, and pass it to summary and progress."""
        content: Any
        try:
            kind, content = device.worker.link.recv()
        except (EOFError, OSError, pickle.UnpicklingError):
            how, remedy = device.worker.describe_end("bake.worlds")
            kind, content = "fault", f"its process {how}; {remedy}"
        if kind == "error":
            raise content
        if kind == "update":
            device.counts = content
            self._report(summary, progress)
        elif kind == "summary":
            device.running = False
            summary.take_summary(content)
        elif kind == "fault":
            device.running, device.fault = False, content
            device.counts |= {"worlds_active": 0, "views_per_s": 0.0, "seconds_left": None}
            progress.note(f"lost {device.name}: {content}" + ("; the others go on" if any(each.running for each in self._devices) else ""))
        else:
            self.report_once(progress, kind, content)

    def _report(self, summary: BakeSummary, progress: Progress) -> None:
        """Report the sum of all devices' counts; the remaining time is that of the slowest one."""
        counts = [device.counts for device in self._devices]
        left = [device.counts["seconds_left"] for device in self._devices if device.running]
        progress.update(
            episodes_done=summary.resumed + sum(each["episodes_done"] for each in counts),
            episodes=summary.total,
            worlds_active=sum(each["worlds_active"] for each in counts),
            views=sum(each["views"] for each in counts),
            views_per_s=sum(each["views_per_s"] for each in counts),
            seconds_left=None if None in left else max(left),
        )

    def _end(self) -> None:
        """Close all links, wait for processes and writers to end, and kill what does not. Never raises."""
        for device in self._devices:
            device.worker.link.close()
        _wait_for_hangup([device.lifeline for device in self._devices], END_TIMEOUT)
        for device in self._devices:
            device.worker.kill()
            os.close(device.lifeline)
        self._devices.clear()


def _start(name: str, program: str, lock: int) -> _Device:
    """Start the bake process of a device, which inherits the lock, and a pipe by whose end this process sees that all of it has ended."""
    with contextlib.ExitStack() as closing:
        lifeline, held = os.pipe()
        closing.callback(os.close, held)
        # A lock that was taken while a standard stream was closed has that stream's number.
        passed = duplicate_above_streams(lock)
        closing.callback(os.close, passed)
        try:
            return _Device(name, start_process(program, (passed, held), environment=_environment(), has_threads=name != "cpu"), lifeline)
        except OSError:
            os.close(lifeline)
            raise


def _environment() -> dict[str, str]:
    """Variables of a device's process: it uses this process's kernel cache, also a temporary one. Empty before Warp has started."""
    cache = wp.config.kernel_cache_dir
    return {} if cache is None else {KERNEL_VARIABLE: os.path.dirname(cache)}


def _wait_for_hangup(pipes: Sequence[int], timeout: float) -> None:
    """Wait until the other ends of all pipes are closed, or the time [s] is over."""
    poll = select.poll()
    for pipe in pipes:
        poll.register(pipe, 0)  # Hang-ups are always reported.
    left, deadline = len(pipes), time.monotonic() + timeout
    while left and (rest := deadline - time.monotonic()) > 0.0:
        for pipe, _ in poll.poll(1e3 * rest):
            poll.unregister(pipe)
            left -= 1


def load_assets(config: Config, note: Callable[[str], None]) -> tuple[Catalog, tuple[EnvironmentMap, ...], Looks | None]:
    """Objects, lights, and what appearance is drawn from; `note` receives remarks about them."""
    catalog, strict = load_catalog(config, report=note), config.objects.strict
    lights = load_scene_lights(config.bake.lights, config.randomize, config.bake.seed, note, strict)
    return catalog, lights, load_looks(config.randomize, note, strict)


@contextlib.contextmanager
def open_exporters(
    out: Path,
    config: Config,
    needs: Needs,
    pool: WriterPool,
    catalog: Catalog,
    cameras: tuple[Camera, ...],
    lights: tuple[EnvironmentMap, ...],
    looks: Looks | None,
) -> Iterator[Exporters]:
    """Exporters of a bake, which are closed at the end; an error in between aborts them and their writers."""
    exporters = Exporters(needs.classes, ExportContext(out, ExportSettings.of(config), catalog, cameras, lights, pool, looks))
    with aborting(pool, exporters):
        yield exporters
        exporters.close()


def prepare_folder(output: OutputFolder, needs: Needs, catalog: Catalog, lights: tuple[EnvironmentMap, ...], looks: Looks | None) -> None:
    """Prepare the output folder (`OutputFolder.prepare`) in a process that generates no episodes itself."""
    config = output.config
    known = with_suctionable_area(catalog, config.suction.radius) if config.bop.graph else catalog
    with (
        WriterPool(1, needs.slot_bytes, output.lock) as pool,
        open_exporters(output.out, config, needs, pool, known, make_cameras(config.rig), lights, looks) as exporters,
    ):
        output.prepare(exporters, digest_inputs(catalog, lights, looks), pool)


def bake_on_devices(
    config: Config,
    output: OutputFolder,
    needs: Needs,
    names: Sequence[str],
    program: str,
    summary: BakeSummary,
    progress: Progress,
) -> None:
    """Generate the remaining episodes of a data set by one process per device, among which `bake.writers` are shared out; `program` is
    Python code that calls `worker.main`. Raises SynpickError if a device was lost, or by a user's mistake. Committed episodes stay."""
    differ = describe_kinds(names)
    if differ:
        progress.note(f"{differ}: devices of different kinds compute other last bits, so an episode depends on its device")
    with DeviceProcesses(names, program, output.lock) as processes:
        report = partial(processes.report_once, progress)
        report("stage", "loading objects and lights")
        catalog, lights, looks = load_assets(config, partial(report, "note"))
        check_disk(forecast_bake(config, catalog, output.remaining), output.out, progress)
        prepare_folder(output, needs, catalog, lights, looks)
        labelled = without_distractors(config.arrangement, config.randomize.most_distractors)
        filled = config.with_values(REPEATS) if must_repeat(labelled, catalog) else config
        dealt = deal_episodes(order_longest_first(filled, catalog, output.remaining, pick_device("cpu")), len(names))
        writers = deal_writers(count_writers(config.bake.writers, needs.slot_bytes), len(names))
        shares = [
            DeviceShare(output.out, config.with_values({"bake.device": name, "bake.writers": count}), episodes, len(names))
            for name, episodes, count in zip(names, dealt, writers, strict=True)
        ]
        lost = processes.run(shares, summary, progress)
    if lost:  # All writers have ended: what is there stays as it is.
        there = len(set(output.episodes).intersection(committed_episodes(output.out)))
        raise DeviceError(f"{lost}; {there} of {summary.total} episodes are complete; the same command resumes, also on other devices")
