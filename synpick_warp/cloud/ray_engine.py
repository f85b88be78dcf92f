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
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from synpick_warp import __version__
from synpick_warp.cloud.claims import LEASE, Chunks, Claims, default_chunk
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.cloud.ray_worker import Board, Job, Report, Worker
from synpick_warp.cloud.run import Baker
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.errors import DeviceError, StoreError
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.pipeline import with_measures
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.processes.interrupt import StopRequest
from synpick_warp.system.progress import Progress
from synpick_warp.system.stores.opening import open_store, probe

ENGINE = "ray"
VERSIONS = ((2, 52), (3,))
"""Versions of Ray, from the first one, which has token authentication, to before the second one."""
_POLL = 1.0
"""Interval of reports [s]."""
_WINDOW = 60.0
"""Time over which the rate is averaged, since workers pause between chunks [s]."""
_SCALE = 10.0
"""Interval at which the cluster's resources are looked up [s]."""
_ANSWER = 5.0
"""Longest time that an address may take to accept a connection [s]."""
_ENDING, _STOPPING = 30.0, 120.0
"""Longest wait for workers: once one has found that all is done, and once they are asked to stop, and upload what is finished [s]."""
MAX_DEATHS = 5
"""Deaths of a worker and its successors without an episode between them, after which the bake ends with an error."""
_SAID = 300
"""Longest part of a message of Ray's that is passed on [characters]."""
STORE_BYTES = 100 << 20
"""Size of a local cluster's object store [B]: workers send counts."""
_ENGINE, _PLACE = re.compile(r"ray(://(\[[0-9a-fA-F:]+\]|[\w.-]+):[0-9]{1,5})?"), re.compile(r"([^/]+):([0-9]{1,5})$")
_VARIABLES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_DEDUP_LOGS": "0"}
"""Variables that Ray reads when it starts: it reports to nobody, and warns of nothing."""


@dataclass
class Crew:
    """Options of a bake on Ray, and what its workers have cost."""

    engine: str = ENGINE
    """"ray": the cluster that RAY_ADDRESS names, or else one on this machine, for this bake. "ray://HOST:PORT": a cluster's Ray Client."""
    workers: int = 0
    """Number of workers; 0: one for each GPU of the cluster, or each CPU core where `bake.device` is cpu, also of those that come later."""
    price: float = 0.0
    """Price of a worker an hour."""
    alive: int = 0
    """Number of workers that run."""
    seconds: float = 0.0
    """Time that workers have run, all together [s]."""

    def __str__(self) -> str:
        cost = f" · cost {self.price * self.seconds / 3600.0:,.2f}" if self.price else ""
        return f"{self.alive} worker{'s' * (self.alive != 1)}{cost}"


def bake_with_ray(
    config: Config,
    url: str,
    progress: Progress,
    crew: Crew,
    splits: Sequence[str] = (),
    bake: Baker | None = None,
    lease: float = LEASE,
) -> BakeSummary:
    """Bake a data set into an object store by claiming workers on a Ray cluster; other claiming workers may take part.

    Args:
        config, url, progress, splits, bake, lease: As of `run.bake_into_store`.
        crew: Options; receives the number of workers and their time.

    Returns:
        Summary of the chunks that ended in this run.

    Raises:
        SynpickError: An error that the user can correct; done episodes stay, and the same command resumes.
    """
    config = with_measures(config, ())
    ranges = DataLayout.of(config).plan(splits)
    planned = sum(map(len, ranges))
    address = find_address(crew.engine)
    ray = import_ray(address)
    if url.startswith("memory:"):
        raise StoreError(f"{url} is in the memory of one process, and Ray's workers have their own; name a store that all of them reach")
    store = open_store(url)
    ledger = Ledger(store, config, probe(store))
    if not ledger.probe.conditional:
        raise StoreError(f"{url} has no conditional writes, by which workers claim; share the episodes out by --shard i/n instead")
    if ledger.finished():
        progress.note("all episodes are done")
        return BakeSummary()
    chunks = Chunks(ledger, Claims(store, ledger.probe.offset, lease), ranges, default_chunk(config.bake.worlds, planned))
    job = pickle.dumps(Job(config, url, tuple(splits), bake, lease))
    progress.stage("starting Ray" if address is None else f"connecting to Ray at {address}")
    with _cluster(ray, address, crew.workers):
        device, each = _resources(ray, config.bake.device, crew.workers)
        return _Driver(ray, crew, progress, job, device, each, (chunks.count_over(), planned)).run()


def import_ray(address: str | None) -> Any:
    """Import Ray, with a token of this process for a cluster on this machine: otherwise Ray writes one into the home directory.

    Raises:
        DeviceError: It is not installed, or of another version.
    """
    given = _VARIABLES if address is not None else _VARIABLES | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
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
        DeviceError: The engine is neither "ray" nor "ray://HOST:PORT", or nobody answers there.
    """
    if _ENGINE.fullmatch(engine) is None:
        raise DeviceError(f"--engine is {engine}; allowed: ray, or ray://HOST:PORT of a Ray Client, such as ray://head:10001")
    address = engine if engine != ENGINE else os.environ.get("RAY_ADDRESS") or None
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
            importlib.import_module("ray._private.worker").print_to_stdstream = lambda *_, **__: None
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
    """Place of a worker in the crew: the actor that has it at present."""

    actor: Any
    number: int
    """Number of the actor; each has another one."""
    deaths: int = 0
    """Deaths since an episode was reported from here."""
    last: Report = field(default_factory=Report)
    is_alive: bool = False
    """Whether it has reported."""


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
        self._ray, self._crew, self._progress, self._job = ray, crew, progress, job
        self._device, self._each, (self._before, self._planned) = device, each, counts
        self._board = ray.remote(Board).options(num_cpus=0, max_restarts=-1).remote()
        self._places: list[_Place] = []
        self._flight: dict[Any, _Place] = {}
        """Calls that run, by their references."""
        self._summary = BakeSummary()
        self._past = [0, 0]
        """Episodes and views of workers that have ended."""
        self._noted: set[str] = set()
        self._count, self._scaled, self._shown = 0, float("-inf"), time.monotonic()
        self._stop = StopRequest()
        self._seen: deque[tuple[float, int]] = deque()
        """Times, and the number of views at these."""

    def run(self) -> BakeSummary:
        """Bake; returns the summary. Raises SynpickError."""
        started, deadline = time.monotonic(), None
        with self._stop:
            while deadline is None or (self._waits() and time.monotonic() < deadline):
                if deadline is None:
                    self._place_workers()
                is_over = self._take_ended(_POLL)
                if deadline is None and (is_over or self._stop.number):
                    deadline = time.monotonic() + (_STOPPING if self._stop.number else _ENDING)
                self._collect()
                self._show()
        self._summary.stopped, self._summary.wall_seconds = self._stop.number, time.monotonic() - started
        return self._summary

    def _waits(self) -> bool:
        """Whether there are workers to wait for at the end: all that run, or after a request to stop those that bake."""
        return any(place.is_alive and (place.last.busy or not self._stop.number) for place in self._flight.values())

    def _place_workers(self) -> None:
        """Add workers up to the number asked for, or that the cluster has resources for."""
        if time.monotonic() - self._scaled < _SCALE:
            return
        self._scaled = time.monotonic()
        name = "GPU" if "num_gpus" in self._each else "CPU"
        wanted = self._crew.workers or int(self._ray.cluster_resources().get(name, 0))
        for _ in range(len(self._places), wanted):
            self._places.append(_Place(None, 0))
            self._start(self._places[-1])

    def _start(self, place: _Place) -> None:
        """Have a new actor take a place; it waits for its resources by itself."""
        self._count += 1
        actor = self._ray.remote(Worker).options(**self._each)
        place.number, place.last, place.is_alive = self._count, Report(), False
        place.actor = actor.remote(place.number, self._board, __version__, self._job, self._device, int(self._each["num_cpus"]))
        self._flight[place.actor.work.remote()] = place

    def _take_ended(self, timeout: float) -> bool:
        """Wait for calls to end, replace workers that have died; returns whether one ended since all is done. Raises its error."""
        if not self._flight:
            time.sleep(timeout)
            return False
        over, errors = False, self._ray.exceptions
        for call in self._ray.wait(list(self._flight), num_returns=1, timeout=timeout)[0]:
            place = self._flight.pop(call)
            try:
                said = self._ray.get(call)
            except errors.RayActorError as error:
                self._replace(place, _describe(error))
                continue
            except errors.RayTaskError as error:
                fault = DeviceError(f"worker {place.number} failed: {error.cause!r}"[:400] + "; the same command resumes")
                fault.add_note(str(error))
                raise fault from None
            if isinstance(said, str) and said:
                raise DeviceError(said)
            if said and not self._stop.number:
                self._replace(place, f"signal {said}")
                continue
            over = True
            self._retire(place)
        return over

    def _replace(self, place: _Place, reason: str) -> None:
        """Replace a dead worker. Its claim runs out, and another worker takes the chunk. Raises DeviceError: too many have died here."""
        self._collect()
        place.deaths += 1
        self._retire(place)
        if place.deaths >= MAX_DEATHS:
            raise DeviceError(f"{place.deaths} workers died one after the other without an episode: {reason}; the same command resumes")
        if not self._stop.number:
            self._progress.note(f"worker {place.number} died, another one takes its place")
            self._start(place)

    def _retire(self, place: _Place) -> None:
        """Add up what a worker has done that has ended."""
        self._past[0] += place.last.episodes
        self._past[1] += place.last.views
        place.last, place.is_alive = Report(), False

    def _collect(self) -> None:
        """Take the reports from the board; none come while it moves to another node."""
        with contextlib.suppress(self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError):
            places = {place.number: place for place in self._places}
            for number, report in self._ray.get(self._board.collect.remote(self._stop.number), timeout=_ENDING).items():
                for note in report.notes:
                    if note not in self._noted:
                        self._noted.add(note)
                        self._progress.note(note)
                for chunk in report.chunks:
                    self._summary.total += chunk.total
                    self._summary.take_summary(chunk)
                if (place := places.get(number)) is not None:
                    place.deaths = place.deaths if report.episodes <= place.last.episodes else 0
                    place.last, place.is_alive = report, True

    def _show(self) -> None:
        """Report sums, remaining time and costs."""
        alive, now = [place.last for place in self._places if place.is_alive], time.monotonic()
        self._crew.alive = len(alive)
        self._crew.seconds += len(alive) * (now - self._shown)
        self._shown = now
        done, views = self._past[0] + sum(each.episodes for each in alive), self._past[1] + sum(each.views for each in alive)
        self._seen.append((now, views))
        while now - self._seen[0][0] > _WINDOW:
            self._seen.popleft()
        rate = (views - self._seen[0][1]) / max(_POLL, now - self._seen[0][0])
        left = max(0, self._planned - self._before - done)
        self._progress.update(
            episodes_done=min(self._planned, self._before + done),
            episodes=self._planned,
            worlds_active=sum(each.worlds for each in alive),
            views=views,
            views_per_s=rate,
            seconds_left=left * views / done / rate if done and rate > 0.0 else None,
        )
