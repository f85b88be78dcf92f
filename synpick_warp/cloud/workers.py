"""Start of a bake into an object store: in this process, by a claiming worker on each of several devices, or by those of a Ray cluster
(`bake --engine ray`): a task a GPU or core, which Ray places and restarts, while claims in the store deal the episodes out.

Apart from `run`, which the workers import.
"""

import importlib
import os
import pickle
import re
import secrets
import signal
import socket
import tempfile
import textwrap
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import FrameType
from typing import Any

from synpick_warp._version import __version__
from synpick_warp.cloud.claims import open_claims, plan_chunks
from synpick_warp.cloud.run import Crew, Job, PlanProgress, bake_into_store, open_ledger
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.errors import ConfigError, DeviceError, SynpickError
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.devices import DeviceProcesses
from synpick_warp.factory.episodes import BakeSummary, count_writers, measured
from synpick_warp.factory.forecast import deal_writers
from synpick_warp.factory.memory_plan import pick_processes
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.factory.worker import BakeLink
from synpick_warp.stages.launch import limit_threads
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.inputs.urls import RAY, check_engine
from synpick_warp.system.processes.interrupt import StopRequest
from synpick_warp.system.progress import Progress, SilentProgress

LEAST_VERSION = (2, 52)
"""Version of Ray from which on it has token authentication."""
RETRIES = 20
"""Deaths of a worker after which the bake ends with an error."""
_POLL = 5.0
"""Interval at which the done chunks are counted [s]."""
_ANSWER = 5.0
"""Connection timeout [s]."""
_ENDING, _STOPPING = 30.0, 120.0
"""Longest wait for workers: once one has found that all is done, and once they are asked to stop, and upload what is finished [s]."""
_SAID = 300
"""Maximum length of an error message of Ray that is shown, which goes on for pages [characters]."""
_PLACE = re.compile(r"([^/]+):([0-9]{1,5})$")
_VARIABLES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_DEDUP_LOGS": "0"}
"""Environment variables that disable usage statistics, a warning about GPUs and the grouping of log lines in Ray."""
_LOCAL = {"RAY_AUTH_MODE": "token", "RAY_worker_niceness": "0"}
"""Environment variables of a cluster that is started here: token authentication, and workers of normal priority. Ray's default niceness of
15 starves them beside other CPU-bound programs."""


def bake_with_ray(job: Job, engine: str, workers: int, progress: Progress, crew: Crew) -> BakeSummary:
    """Bake a data set into an object store by claiming workers on a Ray cluster; other claiming workers may take part. Other arguments as
    of `workers.start_bake`. `engine`: "ray" is the cluster at RAY_ADDRESS, or else a local one, started for this bake; "ray://HOST:PORT" is
    reached by Ray Client. `workers`: number of workers; 0: as many as the cluster has GPUs at the time, or CPU cores with `bake.device`
    cpu. Returns the summary of the workers that ended."""
    job = replace(job, config=measured(job.config, ()))
    address = find_address(engine)
    ray = import_ray(address)
    ledger = open_ledger(job)
    chunks = plan_chunks(ledger, open_claims(ledger, job.lease), DataLayout.of(job.config).plan(job.splits))
    if ledger.finished():
        progress.note("all episodes are done")
        return BakeSummary()
    place = "this machine" if address is None else address
    progress.stage(f"starting Ray on {place}" if address is None else f"connecting to Ray at {place}")
    with tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as folder:
        own = {"_temp_dir": folder, "num_cpus": max(count_cores(), workers), "include_dashboard": False} if address is None else {}
        try:
            ray.init(address=address or "local", log_to_driver=False, logging_level="ERROR", **own)
            device, each, count = _resources(ray, job.config.bake.device, workers)
            cores = each["num_cpus"]
            data = pickle.dumps(replace(job, own={"bake.device": device, "bake.writers": job.config.bake.writers or cores}))
            start = ray.remote(max_retries=RETRIES, **each)(run_ray_worker).remote
            return _await(ray, [start(__version__, data, cores) for _ in range(count)], PlanProgress(progress, chunks, crew))
        except ray.exceptions.RayTaskError:  # A fault of ours, with its traceback.
            raise
        except (ray.exceptions.RayError, OSError, RuntimeError, ValueError) as error:  # It is not there, refuses, is lost, or workers died.
            said = textwrap.shorten(str(error), _SAID, placeholder="…")
            raise DeviceError(f"Ray failed on {place}: {said}; the same command resumes") from error
        finally:
            ray.shutdown()


def run_ray_worker(version: str, data: bytes, cores: int) -> BakeSummary | str:
    """Ray task: claim and bake chunks until all episodes of a job are done; returns the summary, or an error that the user can correct.
    `version`: version of the driver's synpick_warp. `data`: pickled `Job`. `cores`: CPU cores of this worker."""
    if version != __version__:
        return f"a Ray worker has synpick-warp {__version__}, and this command {version}; install one version everywhere"
    limit_threads(cores)
    try:
        return bake_into_store(pickle.loads(data), SilentProgress(), claim=True)
    except SynpickError as error:
        return str(error) or type(error).__name__


def _await(ray: Any, calls: list[Any], progress: PlanProgress) -> BakeSummary:
    """Show how many episodes are done until the calls of `run_ray_worker` have ended; a signal stops them. Returns the sum of their
    summaries.

    Raises DeviceError: a worker reports an error that the user can correct.
    """
    summary, deadline, started = BakeSummary(), float("inf"), time.monotonic()
    with StopRequest() as stop:
        while calls and time.monotonic() < deadline:
            ended, calls = ray.wait(calls, timeout=_POLL)
            for call in ended:
                try:
                    found = ray.get(call)
                except ray.exceptions.RayError:
                    if stop.number:  # It was cancelled.
                        continue
                    raise
                if isinstance(found, str):
                    raise DeviceError(found)
                summary.total += found.total
                summary.take_summary(found)
                deadline = min(deadline, time.monotonic() + _ENDING)
            if stop.number and not summary.stopped:
                summary.stopped, deadline = stop.number, time.monotonic() + _STOPPING
                for call in calls:
                    ray.cancel(call)  # An interrupt, which `StopRequest` of the running bake takes.
            progress.count(len(calls))
    summary.wall_seconds = time.monotonic() - started
    return summary


def import_ray(address: str | None) -> Any:
    """Import Ray, with a token of this process for a cluster on this machine: otherwise Ray writes one into the home directory.

    Raises DeviceError: It is not installed, or too old.
    """
    given = _VARIABLES if address is not None else _VARIABLES | _LOCAL | {"RAY_AUTH_TOKEN": secrets.token_hex(32)}
    for name, value in given.items():
        os.environ.setdefault(name, value)  # Ray reads them when it is imported.
    wanted = f"--engine ray needs Ray >= {'.'.join(map(str, LEAST_VERSION))}: pip install 'synpick-warp[ray]'"
    try:
        ray = importlib.import_module("ray")
    except ImportError as error:
        raise DeviceError(f"{wanted} ({error})") from None
    if tuple(int(part) for part in re.findall(r"[0-9]+", ray.__version__)[:2]) < LEAST_VERSION:
        raise DeviceError(f"{wanted}; here is Ray {ray.__version__}")
    return ray


def find_address(engine: str) -> str | None:
    """Address of the cluster that an engine names, for `ray.init`; None: one on this machine is to be started. Raises DeviceError: there is
    no such engine, or nobody answers there."""
    check_engine(engine)
    address = engine if engine != RAY else os.environ.get("RAY_ADDRESS") or None
    if address is not None and (match := _PLACE.search(address)) is not None:
        try:
            socket.create_connection((match[1].strip("[]"), int(match[2])), _ANSWER).close()
        except (OSError, OverflowError, UnicodeError) as error:
            raise DeviceError(f"{address} does not answer ({error}); start the cluster, or name the address of its head") from None
    return address


def _resources(ray: Any, device: str, workers: int) -> tuple[str, dict[str, int], int]:
    """Device of a worker, the resources that it asks for, a GPU with its part of its node's cores, or a core, and the number of workers.
    Raises DeviceError: the cluster has no GPU, and no worker is asked for that could wait for one."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    shares = [int(node.get("CPU", 0) // node["GPU"]) for node in nodes if node.get("GPU", 0) >= 1]
    if device == "cpu" or (device == "auto" and not shares and not workers):
        return "cpu", {"num_cpus": 1}, workers or sum(int(node.get("CPU", 0)) for node in nodes)
    if not shares and not workers:
        raise DeviceError(f"bake.device is {device}, and the Ray cluster has no GPU; use --device cpu, or --workers that wait for one")
    gpus = sum(int(node.get("GPU", 0)) for node in nodes)
    return "cuda:0", {"num_gpus": 1, "num_cpus": max(1, min(shares, default=1))}, workers or gpus


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
