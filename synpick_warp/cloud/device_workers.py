"""Claiming workers of one command, a process a device (`bake --claim --devices`): worlds, models and kernels last from chunk to chunk."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import FrameType

from synpick_warp.cloud.claims import open_claims, plan_chunks
from synpick_warp.cloud.crew import Crew, CrewProgress
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.cloud.run import Job, bake_into_store
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.errors import DeviceError
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.devices import DeviceProcesses
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.kept import keeping_baker
from synpick_warp.factory.order import deal_writers
from synpick_warp.factory.pipeline import with_measures
from synpick_warp.factory.sizes import count_writers, pick_processes
from synpick_warp.factory.worker import BakeLink
from synpick_warp.stages.launch import limit_threads
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.progress import ForwardingProgress, Progress
from synpick_warp.system.stores.opening import open_store, probe

_PROGRAM = "from synpick_warp.cloud.device_workers import run_worker; from synpick_warp.factory.worker import main; main(run_worker)"


@dataclass(frozen=True, kw_only=True)
class _Share(Job):
    """Job of one worker, with what is its own."""

    folder: str
    """Folder for temporary files."""
    processes: int
    """Workers on this host, which share its memory."""
    own: Mapping[str, object]
    """Full key -> value of settings of the worker alone: device, writers."""


def bake_with_devices(job: Job, devices: Sequence[str], progress: Progress, crew: Crew | None = None) -> BakeSummary:
    """Bake a data set into an object store by a claiming worker on each device; other claiming workers may take part.

    Args:
        job: What to bake.
        devices: As in `pipeline.run_bake`.
        progress: Observer.
        crew: Receives the number of workers and their time, for a price; None: there is none.

    Returns:
        Summary of the chunks of these workers.

    Raises:
        SynpickError: An error that the user can correct; done episodes stay, and the same command resumes.
    """
    config = with_measures(job.config, devices)
    ranges = DataLayout.of(config).plan(job.splits)
    planned = sum(map(len, ranges))
    names = pick_processes(config, devices, planned)
    needs, summary, crew = Needs.of(config), _Totals(planned), crew or Crew("")
    writers = deal_writers(count_writers(config.bake.writers, needs.slot_bytes), len(names))
    with tempfile.TemporaryDirectory(prefix="synpick-workers-") as folder:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            with DeviceProcesses(names, _PROGRAM, handle) as processes:  # They load their libraries meanwhile.
                store = open_store(job.url)
                ledger = Ledger(store, config, probe(store))
                claims = open_claims(ledger, job.lease)
                if ledger.finished():
                    progress.note("all episodes are done")
                    return BakeSummary()
                common = {**vars(job), "config": config, "folder": folder, "processes": len(names)}
                own = [{"bake.device": name, "bake.writers": count} for name, count in zip(names, writers, strict=True)]
                crew.alive = len(names)
                shown = CrewProgress(progress, crew, plan_chunks(ledger, claims, ranges).count_over(), planned)
                lost = processes.run([_Share(**common, own=each) for each in own], summary, shown)
        finally:
            os.close(handle)
    if lost and not summary.stopped and not ledger.finished():
        raise DeviceError(f"{lost}; the same command resumes, also on other devices")
    if not summary.stopped:
        summary.total = summary.taken
    return summary


@dataclass
class _Totals(BakeSummary):
    """Summary of all workers."""

    taken: int = 0
    """Episodes of the chunks that have ended."""

    def take_summary(self, other: BakeSummary) -> None:
        """Add a worker's summary, and its number of episodes."""
        super().take_summary(other)
        self.taken += other.total


class _Stopped(BaseException):
    """Request to stop a worker that bakes nothing at present."""


class _Relay(ForwardingProgress):
    """Observer of a worker's bakes that passes reports on to the main process, with counts over all of its bakes."""

    def __init__(self, link: BakeLink) -> None:
        super().__init__(link)
        self.busy = False
        """Whether a chunk is baked, which then ends by itself when the link requests a stop."""
        self.ended = BakeSummary()
        """Summary of the chunks that have ended."""

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Pass counts on, without the remaining time, which is that of one bake. See `Progress`."""
        done, views = len(self.ended.episodes) + episodes_done, self.ended.views + views
        given = {"worlds_active": worlds_active, "views": views, "views_per_s": views_per_s, "seconds_left": None}
        super().update(episodes_done=done, episodes=episodes, **given)

    def bake(self, job: _Share, bake: Callable[..., BakeSummary], _: object, *given: object) -> BakeSummary:
        """Bake a chunk with the worker's own settings, and add its summary."""
        self.busy = True
        try:
            part = bake(job.config.with_values(job.own), *given)
        finally:
            self.busy = False
        self.ended.total += part.total
        self.ended.take_summary(part)
        return part


def run_worker(job: _Share, _: Sequence[int], link: BakeLink) -> BakeSummary:
    """Claim and bake chunks on one device, in its process, until all episodes are done; arguments as of `pipeline.generate_share`."""
    tempfile.tempdir = job.folder  # The main process removes it, however this one ends.
    if job.own["bake.device"] == "cpu":
        limit_threads(max(1, count_cores() // job.processes))
    relay = _Relay(link)

    def stop(number: int, _: FrameType | None) -> None:
        link.number = link.number or number
        if not relay.busy:
            raise _Stopped

    signal.signal(signal.SIGTERM, stop)
    link.on_stop = partial(os.kill, os.getpid(), signal.SIGTERM)
    try:
        if link.number:
            raise _Stopped
        bake = partial(relay.bake, job, job.bake or keeping_baker(job.processes, link))
        given = {"splits": job.splits, "lease": job.lease, "workers": job.processes}
        return bake_into_store(job.config, job.url, relay, bake=bake, claim=True, **given)
    except _Stopped:
        relay.ended.stopped = link.number
        return relay.ended
