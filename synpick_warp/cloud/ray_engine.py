"""Bake on a Ray cluster (`bake --engine ray`): the driver places claiming workers, replaces dead ones, and shows what they report."""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import re
import secrets
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from synpick_warp import __version__
from synpick_warp.cloud.claims import open_claims, plan_chunks
from synpick_warp.cloud.crew import RAY, Crew, CrewProgress
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.cloud.ray_worker import Board, Report, Worker
from synpick_warp.cloud.run import Job
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.errors import DeviceError
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.pipeline import with_measures
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.processes.interrupt import StopRequest
from synpick_warp.system.progress import Progress
from synpick_warp.system.stores.opening import open_store, probe

VERSIONS = ((2, 52), (3,))
"""Versions of Ray, from the first one, which has token authentication, to before the second one."""
_POLL = 1.0
"""Interval of reports [s]."""
_ANSWER = 5.0
"""Connection timeout [s]."""
_ENDING, _STOPPING = 30.0, 120.0
"""Longest wait for workers: once one has found that all is done, and once they are asked to stop, and upload what is finished [s]."""
MAX_DEATHS = 5
"""Deaths of a worker and its successors without an episode between them, after which the bake ends with an error."""
_SAID = 300
"""Maximum length of an error message of Ray that is shown; longer ones are cut [characters]."""
STORE_BYTES = 100 << 20
"""Size of a local cluster's object store [B]: workers send counts."""
_PLACE = re.compile(r"([^/]+):([0-9]{1,5})$")
_VARIABLES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_DEDUP_LOGS": "0"}
"""Environment variables that disable usage statistics, a warning about GPUs and the grouping of log lines in Ray."""
_LOCAL = {"RAY_AUTH_MODE": "token", "RAY_worker_niceness": "0"}
"""Environment variables of a cluster that is started here: token authentication, and workers of normal priority. Ray's default niceness of
15 starves them beside other CPU-bound programs."""


def bake_with_ray(job: Job, crew: Crew, progress: Progress) -> BakeSummary:
    """Bake a data set into an object store by claiming workers on a Ray cluster; other claiming workers may take part.

    Args:
        job: What to bake.
        crew: Options; receives the number of workers and their time.
        progress: Observer.

    Returns:
        Summary of the chunks that ended in this run.

    Raises:
        SynpickError: An error that the user can correct; done episodes stay, and the same command resumes.
    """
    job = replace(job, config=with_measures(job.config, ()))
    config, url, ranges = job.config, job.url, DataLayout.of(job.config).plan(job.splits)
    planned = sum(map(len, ranges))
    address = find_address(crew.engine)
    ray = import_ray(address)
    store = open_store(url)
    ledger = Ledger(store, config, probe(store))
    claims = open_claims(ledger, job.lease)
    if ledger.finished():
        progress.note("all episodes are done")
        return BakeSummary()
    progress.stage("starting Ray" if address is None else f"connecting to Ray at {address}")
    with _cluster(ray, address, crew.workers):
        device, each = _resources(ray, config.bake.device, crew.workers)
        before = plan_chunks(ledger, claims, ranges).count_over()
        return _Driver(ray, crew, progress, pickle.dumps(job), device, each, (before, planned)).run()


def import_ray(address: str | None) -> Any:
    """Import Ray, with a token of this process for a cluster on this machine: otherwise Ray writes one into the home directory.

    Raises:
        DeviceError: It is not installed, or of another version.
    """
    given = _VARIABLES if address is not None else _VARIABLES | _LOCAL | {"RAY_AUTH_TOKEN": secrets.token_hex(32)}
    for name, value in given.items():
        os.environ.setdefault(name, value)  # Ray reads them when it is imported.
    low, high = (".".join(map(str, each)) for each in VERSIONS)
    wanted = f"Ray >= {low}, < {high}: pip install 'synpick-warp[ray]'"
    try:
        ray = importlib.import_module("ray")
    except ImportError as error:
        raise DeviceError(f"--engine ray needs {wanted} ({error})") from None
    known = tuple(int(part) for part in re.findall(r"[0-9]+", ray.__version__)[:2])
    if not VERSIONS[0] <= known < VERSIONS[1]:
        raise DeviceError(f"--engine ray needs {wanted}; here is Ray {ray.__version__}")
    return ray


def find_address(engine: str) -> str | None:
    """Address of the cluster that an engine names, for `ray.init`; None: one on this machine is to be started.

    Raises:
        DeviceError: Nobody answers there.
    """
    address = engine if engine != RAY else os.environ.get("RAY_ADDRESS") or None
    if address is not None and (match := _PLACE.search(address)) is not None:
        try:
            socket.create_connection((match[1].strip("[]"), int(match[2])), _ANSWER).close()
        except (OSError, OverflowError, UnicodeError) as error:
            raise DeviceError(f"{address} does not answer ({error}); start the cluster, or name the address of its head") from None
    return address


@contextlib.contextmanager
def _cluster(ray: Any, address: str | None, workers: int) -> Iterator[None]:
    """Connect to a cluster, or start one on this machine, with a token of its own and its files in a temporary folder.

    Raises:
        DeviceError: Ray cannot be started, or the cluster refuses the connection, or is lost.
    """
    folder, before = None, os.environ.get("TMPDIR")
    given: dict[str, Any] = {"address": address or "local", "log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address is None:
            # Workers inherit it, and leave files in it when they are killed.
            folder = os.environ["TMPDIR"] = tempfile.mkdtemp(prefix="ray-")
            cores = max(count_cores(), workers)
            given |= {"_temp_dir": folder, "num_cpus": cores, "include_dashboard": False, "object_store_memory": STORE_BYTES}
        try:
            ray.init(**given)
            # Otherwise logs of dead nodes go through the display, whatever `log_to_driver` is.
            ray._private.worker.print_to_stdstream = lambda *_, **__: None
        except Exception as error:  # ConnectionError, RuntimeError, ValueError and classes of Ray's, each for several reasons.
            raise DeviceError(f"Ray cannot be used at {address or 'this machine'}: {_describe(error)}") from error
        try:
            yield
        except (ray.exceptions.RaySystemError, ConnectionError) as error:
            raise DeviceError(f"the Ray cluster was lost: {_describe(error)}; the same command resumes") from error
    finally:
        ray.shutdown()
        if folder is not None:
            os.environ.pop("TMPDIR") if before is None else os.environ.update(TMPDIR=before)
            shutil.rmtree(folder, ignore_errors=True)


def _describe(error: Exception) -> str:
    """What an error of Ray says, in one line: the beginning, since it goes on for pages."""
    text = " ".join(str(error).split())
    return text if len(text) <= _SAID else f"{text[:_SAID]}…"


def _resources(ray: Any, device: str, workers: int) -> tuple[str, dict[str, float]]:
    """Device of a worker, and the resources that it asks for: a GPU with its part of its node's cores, or a core.

    Raises:
        DeviceError: The cluster has no GPU, and no worker is asked for that could wait for one.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    shares = [int(node.get("CPU", 0) // node["GPU"]) for node in nodes if node.get("GPU", 0) >= 1]
    if device == "cpu" or (device == "auto" and not shares and not workers):
        return "cpu", {"num_cpus": 1}
    if not shares and not workers:
        raise DeviceError(f"bake.device is {device}, and the Ray cluster has no GPU; use --device cpu, or --workers that wait for one")
    return "cuda:0", {"num_gpus": 1, "num_cpus": max(1, min(shares, default=1))}


@dataclass(eq=False)
class _Place:
    """Place of a worker in the crew: the actor that has it at present, with a number that no other has."""

    number: int = 0
    actor: Any = None
    """Handle, without which Ray ends the actor."""
    deaths: int = 0
    """Deaths since an episode was reported from here."""


class _Driver:
    """Main loop: places workers as resources come, replaces dead ones, adds up reports, until one worker finds that all is done."""

    def __init__(
        self, ray: Any, crew: Crew, progress: Progress, job: bytes, device: str, each: dict[str, float], counts: tuple[int, int]
    ) -> None:
        """
        Args:
            ray: The package.
            crew: Options and costs.
            progress: Observer.
            job: Pickled `Job`.
            device, each: Device and resources of a worker.
            counts: Episodes that are done, and all.
        """
        self._ray, self._crew, self._progress = ray, crew, CrewProgress(progress, crew, *counts)
        self._resource = "GPU" if "num_gpus" in each else "CPU"
        self._board = ray.remote(Board).options(num_cpus=0, max_restarts=-1).remote()
        self._make = partial(ray.remote(Worker).options(**each).remote, self._board, __version__, job, device, int(each["num_cpus"]))
        self._places: list[_Place] = []
        self._flight: dict[Any, _Place] = {}
        """Calls that run, by their references."""
        self._reports: dict[int, Report] = {}
        """Last report of each actor, also of those that have ended."""
        self._summary, self._noted, self._stop = BakeSummary(), set[str](), StopRequest()

    def run(self) -> BakeSummary:
        """Bake; returns the summary. At the end it waits for workers that run, after a request to stop for those that bake.

        Raises:
            SynpickError: An error that the user can correct.
        """
        started, deadline, last = time.monotonic(), None, set[int]()
        with self._stop:
            while deadline is None or (last & {place.number for place in self._flight.values()} and time.monotonic() < deadline):
                if deadline is None:
                    wanted = self._crew.workers or int(self._ray.cluster_resources().get(self._resource, 0))
                    while len(self._places) < wanted:
                        self._places.append(_Place())
                        self._start(self._places[-1])
                is_over = self._take_ended()
                if deadline is None and (is_over or self._stop.number):
                    deadline = time.monotonic() + (_STOPPING if self._stop.number else _ENDING)
                    last = {number for number, report in self._alive.items() if report.busy or not self._stop.number}
                self._collect()
                self._show()
        self._summary.stopped, self._summary.wall_seconds = self._stop.number, time.monotonic() - started
        return self._summary

    @property
    def _alive(self) -> dict[int, Report]:
        """Last reports of the workers that run, by number."""
        return {place.number: self._reports[place.number] for place in self._flight.values() if place.number in self._reports}

    def _start(self, place: _Place) -> None:
        """Have a new actor take a place; it waits for its resources by itself."""
        place.number = 1 + max(each.number for each in self._places)
        place.actor = self._make(place.number)
        self._flight[place.actor.work.remote()] = place

    def _take_ended(self) -> bool:
        """Wait for a call to end, for _POLL at most, and replace workers that have died.

        Returns:
            Whether one ended since all is done, or since it was to stop.

        Raises:
            DeviceError: A worker reports an error that the user can correct, or too many have died in one place.
        """
        if not self._flight:
            time.sleep(_POLL)
        for call in self._ray.wait(list(self._flight), timeout=_POLL)[0] if self._flight else ():
            place = self._flight.pop(call)
            try:
                said = self._ray.get(call)
            except self._ray.exceptions.RayActorError as error:
                said = 0, _describe(error)
            if isinstance(said, str) and said:
                raise DeviceError(said)
            if not said or self._stop.number:
                return True
            self._collect()
            place.deaths += 1
            if place.deaths >= MAX_DEATHS:
                raise DeviceError(f"{MAX_DEATHS} workers died one after the other without an episode ({said}); the same command resumes")
            self._progress.note(f"worker {place.number} died, another one takes its place")
            self._start(place)  # The claim of the dead one runs out, and some worker takes its chunk.
        return False

    def _collect(self) -> None:
        """Take the reports from the board; none come while it moves to another node."""
        reports: dict[int, Report] = {}
        with contextlib.suppress(self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError):
            reports = self._ray.get(self._board.collect.remote(self._stop.number), timeout=_ENDING)
        for number, report in reports.items():
            for note in report.notes:
                if note not in self._noted:
                    self._noted.add(note)
                    self._progress.note(note)
            for chunk in report.chunks:
                self._summary.total += chunk.total
                self._summary.take_summary(chunk)
            if report.episodes > self._reports.get(number, Report()).episodes:
                for place in self._places:
                    place.deaths = 0 if place.number == number else place.deaths
            self._reports[number] = report

    def _show(self) -> None:
        """Update the display: totals over all workers."""
        alive = self._alive
        self._crew.alive = len(alive)
        done, views = (sum(getattr(report, name) for report in self._reports.values()) for name in ("episodes", "views"))
        worlds = sum(report.worlds for report in alive.values())
        self._progress.update(episodes_done=done, episodes=0, worlds_active=worlds, views=views, views_per_s=0.0, seconds_left=None)
