"""Ray actors of a bake: claiming workers, one for each GPU or CPU core, and a message board for their reports. Ray is imported by running
actors only.

Claims in the store deal the chunks out, and done marks commit episodes; what workers report is for the display and the summary alone.
"""

from __future__ import annotations

import contextlib
import pickle
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from synpick_warp import __version__
from synpick_warp.cloud.run import Job, bake_into_store
from synpick_warp.errors import SynpickError
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.kept import keeping_baker
from synpick_warp.stages.launch import limit_threads
from synpick_warp.system.progress import SilentProgress

REPORT_INTERVAL = 1.0
"""Minimum time between two reports of a worker [s]."""


@dataclass
class Report:
    """Progress report of a worker: counts since its start; notes and summaries since its last report."""

    busy: bool = False
    """Whether it bakes; False: it looks for a free chunk, or waits for other workers."""
    episodes: int = 0
    views: int = 0
    worlds: int = 0
    """Worlds that run an episode."""
    notes: list[str] = field(default_factory=list)
    chunks: list[BakeSummary] = field(default_factory=list)
    """Summaries of the chunks that have ended."""


class Board:
    """Message board: an actor to which workers post reports, which the driver collects. It passes the driver's request to stop on."""

    def __init__(self) -> None:
        self._reports: dict[int, Report] = {}
        self._stop = 0

    def post(self, worker: int, report: Report) -> int:
        """Store a report, with the notes and summaries of those not yet collected. Returns the signal for which to stop, or 0."""
        if (before := self._reports.get(worker)) is not None:
            report = replace(report, notes=before.notes + report.notes, chunks=before.chunks + report.chunks)
        self._reports[worker] = report
        return self._stop

    def collect(self, stop: int) -> dict[int, Report]:
        """Return the reports since the last call, by worker. `stop`: signal for which workers are to stop, or 0."""
        self._stop, reports = stop, self._reports
        self._reports = {}
        return reports


class Reporter(SilentProgress):
    """Observer of a worker's bakes that posts reports, and raises the driver's request to stop as SIGTERM in this process."""

    def __init__(self, post: Callable[[Report], Any], read: Callable[[Any], int | None]) -> None:
        """
        Args:
            post: Sends a report, and returns a handle of its answer, without waiting.
            read: Returns the answer of a handle: the signal for which to stop, or 0; None: it is pending.
        """
        self._post, self._read = post, read
        self._now, self._ended, self._posted = Report(), (0, 0), float("-inf")
        self._answer: Any = None

    def stage(self, text: str) -> None:
        """Report a stage as a note."""
        self.note(text)

    def note(self, text: str) -> None:
        """See `Progress`."""
        self._now.notes.append(text)
        self._send()

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Post counts, at most once every REPORT_INTERVAL. See `Progress`."""
        before = self._ended
        self._now.episodes, self._now.views = before[0] + episodes_done, before[1] + views
        self._now.worlds = worlds_active
        if self._answer is not None and (stop := self._read(self._answer)) is not None:
            self._answer = None
            if stop:
                signal.raise_signal(signal.SIGTERM)  # `StopRequest` of the running bake takes it.
        if time.monotonic() - self._posted >= REPORT_INTERVAL:
            self._send()

    @contextlib.contextmanager
    def chunk(self, ended: list[BakeSummary]) -> Iterator[None]:
        """Context manager of a bake, which marks the worker as busy. On exit the summaries in `ended` are posted."""
        self._now.busy = True
        try:
            yield
        finally:
            self._ended = (self._ended[0] + sum(len(each.episodes) for each in ended), self._ended[1] + sum(each.views for each in ended))
            self._now = Report(False, *self._ended, notes=self._now.notes, chunks=ended)
            self._send()

    def _send(self) -> None:
        """Send the report, then remove its notes and chunk summaries from the next one."""
        self._answer, self._posted = self._post(self._now), time.monotonic()
        self._now = replace(self._now, notes=[], chunks=[])


class Worker:
    """Actor that bakes chunks which it claims, until all episodes of a job are done. Kernels, objects and worlds stay loaded meanwhile."""

    def __init__(self, board: Any, version: str, job: bytes, device: str, cores: int, number: int) -> None:
        """
        Args:
            board: Handle of the `Board`.
            version: Version of the driver's synpick_warp.
            job: Pickled `Job`.
            device: Device of the bakes.
            cores: CPU cores of this worker.
            number: Number of this worker.
        """
        self._given = (board, version, job, device, cores, number)

    def work(self) -> str | int:
        """Bake until nothing is left; returns an empty string then, an error that the user can correct, or the signal that stopped it."""
        import ray  # An actor has it.
        import ray.exceptions

        board, version, data, device, cores, number = self._given
        if version != __version__:
            return f"a Ray worker has synpick-warp {__version__}, and this command {version}; install one version everywhere"
        job: Job = pickle.loads(data)

        def read(answer: Any) -> int | None:
            with contextlib.suppress(ray.exceptions.RayError):  # The board is lost, and starts anew elsewhere.
                return ray.get(answer) if ray.wait([answer], timeout=0)[0] else None
            return 0

        reporter = Reporter(lambda report: board.post.remote(number, report), read)
        limit_threads(cores)
        own = {"bake.device": device, "bake.writers": job.config.bake.writers or cores}
        bake = job.bake or keeping_baker()

        def report(config: Any, *given: Any) -> BakeSummary:
            ended: list[BakeSummary] = []
            with reporter.chunk(ended):
                ended.append(bake(config.with_values(own), *given))
            return ended[0]

        try:
            summary = bake_into_store(job.config, job.url, reporter, splits=job.splits, bake=report, claim=True, lease=job.lease)
        except SynpickError as error:
            return str(error) or type(error).__name__
        return summary.stopped or ""
