"""Start of a bake into an object store: in this process, by a claiming worker on each of several devices, or by those of a Ray cluster.

Apart from `run`, which the workers import.
"""

import os
import signal
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import FrameType
from typing import Any

from synpick_warp.cloud.claims import open_claims, plan_chunks
from synpick_warp.cloud.ray_engine import bake_with_ray
from synpick_warp.cloud.run import Crew, Job, PlanProgress, bake_into_store, open_ledger
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.errors import ConfigError, DeviceError
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.devices import DeviceProcesses
from synpick_warp.factory.episodes import BakeSummary, count_writers, measured
from synpick_warp.factory.forecast import deal_writers
from synpick_warp.factory.memory_plan import pick_processes
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.factory.worker import BakeLink
from synpick_warp.stages.launch import limit_threads
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.progress import Progress

_PROGRAM = "from synpick_warp.factory.worker import main; main('synpick_warp.cloud.workers', 'run_worker')"


def start_bake(
    job: Job,
    progress: Progress,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    devices: Sequence[str] = (),
    *,
    claim: bool = False,
    engine: str = "",
    workers: int = 0,
    crew: Crew | None = None,
) -> BakeSummary:
    """Bake a data set into an object store; other arguments as of `synpick_warp.bake`. `crew` receives number and time of the workers of an
    engine, or of claiming ones on these devices, for a display.

    Raises ConfigError: claims share out the episodes, and so does `shard`; a cluster's devices are its own; SynpickError: as
    `run.bake_into_store`."""
    job, crew = replace(job, splits=tuple(splits)), crew or Crew()
    if (claim or engine) and shard != (0, 1):
        raise ConfigError("workers that claim share out the episodes among them; drop the shard")
    if engine and devices:
        raise ConfigError("an engine places one worker a GPU or core of its cluster; drop the devices")
    if engine:
        return bake_with_ray(job, engine, workers, progress, crew)
    if claim and devices:
        return bake_with_devices(job, devices, progress, crew)
    return bake_into_store(job, progress, shard, devices, claim=claim)


@dataclass(frozen=True, kw_only=True)
class _Share(Job):
    """Job of one device's worker."""

    folder: str
    """Folder for temporary files."""
    processes: int
    """Workers on this host, which share its memory."""


def bake_with_devices(job: Job, devices: Sequence[str], progress: Progress, crew: Crew) -> BakeSummary:
    """Bake a data set into an object store by a claiming worker on each device; other claiming workers may take part. Arguments as of
    `start_bake`; returns the summary of the chunks of these workers."""
    job = replace(job, config=measured(job.config, devices))
    config, ranges = job.config, DataLayout.of(job.config).plan(job.splits)
    planned = sum(map(len, ranges))
    names = pick_processes(config, devices, planned)
    needs, summary = Needs.of(config), BakeSummary(planned)
    writers = deal_writers(count_writers(config.bake.writers, needs.slot_bytes), len(names))
    with tempfile.TemporaryDirectory(prefix="synpick-workers-") as folder:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            with DeviceProcesses(names, _PROGRAM, handle) as processes:  # They load their libraries meanwhile.
                ledger = open_ledger(job)
                claims = open_claims(ledger, job.lease)
                if ledger.finished():
                    progress.note("all episodes are done")
                    return BakeSummary()
                own = [{"bake.device": name, "bake.writers": count} for name, count in zip(names, writers, strict=True)]
                shares = [_Share(**vars(replace(job, own=each)), folder=folder, processes=len(names)) for each in own]
                crew.alive = len(names)
                lost = processes.run(shares, summary, PlanProgress(progress, plan_chunks(ledger, claims, ranges), crew))
        finally:
            os.close(handle)
    if lost and not summary.stopped and not ledger.finished():
        raise DeviceError(f"{lost}; the same command resumes, also on other devices")
    if not summary.stopped:
        summary.total = len(summary.episodes)
    return summary


class _Stopped(BaseException):
    """Request to stop a worker that bakes nothing at present."""


def run_worker(job: _Share, _: Sequence[int], link: BakeLink) -> BakeSummary:
    """Claim and bake chunks on one device, in its process, until all episodes are done; arguments as of `pipeline.generate_share`."""
    tempfile.tempdir = job.folder  # The main process removes it, however this one ends.
    if job.own["bake.device"] == "cpu":
        limit_threads(max(1, count_cores() // job.processes))
    real = job.bake or partial(bake_episodes, processes=job.processes, stop=link)
    summary, is_busy = BakeSummary(), False

    def bake(*given: Any) -> BakeSummary:
        nonlocal is_busy
        is_busy = True
        try:
            return real(*given)
        finally:
            is_busy = False

    def stop(number: int, _: FrameType | None) -> None:
        link.number = link.number or number
        if not is_busy:  # A bake ends by itself when the link requests a stop.
            raise _Stopped

    signal.signal(signal.SIGTERM, stop)
    link.on_stop = partial(os.kill, os.getpid(), signal.SIGTERM)
    try:
        if link.number:
            raise _Stopped
        bake_into_store(replace(job, bake=bake), link, claim=True, workers=job.processes, summary=summary)
    except _Stopped:
        summary.stopped = link.number
    return summary
