"""Writer processes: bounded queues, images handed over through shared memory, and no failure unheard."""

from __future__ import annotations

import contextlib
import mmap
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import output_error
from synpick_warp.exporters.writing.worker import Failure, SharedImage, Task, run

_WORKER = "from synpick_warp.exporters.writing.worker import main; main()"
"""Program of a writer process: imported, not run as `__main__`, so that pickled tasks name the module's own classes."""
QUEUE_DEPTH = 4
"""Tasks that a process has at hand, with the one it runs: enough to bridge the time in which the bake makes the next batch."""
PROCESSES_PER_COPIER = 4
"""So many processes for a thread that copies images into shared memory: one core alone cannot copy as fast as many cores write."""
_ALIGNMENT = 64
"""Images begin at a multiple of a cache line [B]."""
_END_TIMEOUT = 10.0
"""How long a process may take to end when it has nothing left to do [s]."""
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
"""The processes are the parallelism: no threads within them."""


@dataclass(frozen=True, eq=False)
class WriteTask:
    """A task to be done: `function(*images, *arguments)` in a process."""

    function: Callable[..., None]
    """Stands at the top of a module that imports quickly."""
    images: Sequence[np.ndarray]
    """Copied into shared memory before the call that brings the order returns."""
    arguments: tuple[Any, ...]
    """Pickled; keep them small."""
    path: Path
    """What the task writes, for error messages."""
    done: Callable[[], None] | None = None
    """Called from a later call of the pool, in the caller's thread, once the task succeeded. It may submit tasks without images."""


@dataclass(eq=False)
class _Job:
    task: Task
    path: Path
    done: Callable[[], None] | None
    slot: int | None
    copying: Future[None] | None
    """A thread's copying of the images; None: they are there."""


@dataclass(eq=False)
class _Worker:
    process: subprocess.Popen[bytes]
    link: Connection
    jobs: deque[_Job] = field(default_factory=deque)


def shared_bytes(sizes: Iterable[int]) -> int:
    """Room that images of these sizes take in shared memory [B]."""
    return sum(-(-size // _ALIGNMENT) * _ALIGNMENT for size in sizes)


class WriterPool:
    """Processes that write files. Use it as a context manager: it closes after success and aborts after an error.

    The processes are interpreters of their own: not forked, because CUDA and threads do not survive a fork, and not
    `multiprocessing`'s spawned ones, because those import the main script again, and with it the whole simulator. The
    shared memory has no name, so there is nothing to leak however the bake ends.
    """

    def __init__(self, processes: int, slot_bytes: int, held: int | None = None) -> None:
        """
        Args:
            processes: How many processes; 0: tasks run in this one.
            slot_bytes: Most room that the images of one task take, see `shared_bytes` [B].
            held: A file handle that the processes hold open until they end, such as one with a lock.

        Raises:
            OutputError: There is no memory or no process to be had.
        """
        self._slot_bytes = -(-max(slot_bytes, 1) // mmap.PAGESIZE) * mmap.PAGESIZE
        slots = max(1, processes * QUEUE_DEPTH)
        self._free = list(range(slots))
        self._waiting: deque[_Job] = deque()
        self._workers: list[_Worker] = []
        self._links = selectors.DefaultSelector()
        self._failure: OutputError | None = None
        self._ended = False
        self._hearing = False
        self._copiers = ThreadPoolExecutor(max(1, processes // PROCESSES_PER_COPIER))
        self._copies_here = processes < 2 * PROCESSES_PER_COPIER
        try:
            handle, self._memory = _shared_memory(slots * self._slot_bytes)
        except OSError as error:
            raise OutputError(f"no shared memory for {processes} writer processes: {error}; set bake.writers lower") from error
        try:
            for _ in range(processes):
                worker = _start(handle, () if held is None else (held,))
                self._workers.append(worker)
                self._links.register(worker.link, selectors.EVENT_READ, worker)
        except OSError as error:
            self.abort()
            raise OutputError(f"cannot start {processes} writer processes: {error}; set bake.writers lower") from error
        finally:
            os.close(handle)

    def submit(
        self,
        function: Callable[..., None],
        images: Sequence[np.ndarray],
        arguments: tuple[Any, ...],
        *,
        path: Path,
        done: Callable[[], None] | None = None,
    ) -> None:
        """Have one `WriteTask` done, which has these parts; see `submit_all`."""
        self.submit_all((WriteTask(function, images, arguments, path, done),))

    def submit_all(self, orders: Iterable[WriteTask]) -> None:
        """Have tasks done, and return when all their images are copied. Tasks with images wait until there is room for these.

        Threads copy the images of some orders while the next one is made, so give orders that take work to make by a generator.

        Raises:
            OutputError: One of these or an earlier task failed, or a process died.
        """
        self._check()
        jobs: list[_Job] = []
        for order in orders:
            slot = self._take_slot() if order.images else None
            places, copying = self._share(order.images, slot)
            jobs.append(_Job(Task(order.function, places, order.arguments), order.path, order.done, slot, copying))
            self._waiting.append(jobs[-1])
            self._collect(0.0)
        for job in jobs:
            _await_copy(job)
        self._collect(0.0)

    def pids(self) -> tuple[int, ...]:
        """Numbers of the processes."""
        return tuple(worker.process.pid for worker in self._workers)

    def poll(self) -> None:
        """Hear from the processes without waiting. Raises like `submit`."""
        self._check()
        self._collect(0.0)

    def wait(self) -> None:
        """Wait until every task is done. Raises like `submit`."""
        self._check()
        self._collect(0.0)
        while self._waiting or any(worker.jobs for worker in self._workers):
            self._collect(None)

    def close(self) -> None:
        """Wait until every task is done, and end the processes. Raises like `submit`; the processes end in any case."""
        if self._ended:
            return
        try:
            self.wait()
            for worker in self._workers:
                worker.link.send(None)
            for worker in self._workers:
                worker.process.wait(_END_TIMEOUT)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise OutputError(f"a writer process did not end: {error}") from error
        finally:
            self.abort()

    def abort(self) -> None:
        """End the processes at once. Never raises."""
        self._ended = True
        for worker in self._workers:
            worker.process.kill()
            worker.process.wait()
            worker.link.close()
        self._workers.clear()
        self._waiting.clear()
        self._links.close()
        self._copiers.shutdown()
        with contextlib.suppress(BufferError):
            self._memory.close()

    def __enter__(self) -> WriterPool:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _take_slot(self) -> int:
        while not self._free:
            self._collect(None)
        return self._free.pop()

    def _share(self, images: Sequence[np.ndarray], slot: int | None) -> tuple[tuple[SharedImage, ...], Future[None] | None]:
        """Places of the images in a slot, and their copying if it goes on."""
        if slot is None:
            return (), None
        if (size := shared_bytes(image.nbytes for image in images)) > self._slot_bytes:
            raise ValueError(f"images of {size} bytes exceed the {self._slot_bytes} that the pool was made for")
        offset = slot * self._slot_bytes
        places: list[SharedImage] = []
        for image in images:
            places.append(SharedImage(offset, image.shape, image.dtype.str))
            offset += shared_bytes((image.nbytes,))
        targets = [place.of(self._memory) for place in places]
        if self._copies_here:
            _copy(targets, images)
            return tuple(places), None
        return tuple(places), self._copiers.submit(_copy, targets, images)

    def _collect(self, timeout: float | None) -> None:
        """Hand out tasks and hear about finished ones; `None` waits for at least one."""
        if not self._workers:
            self._run_here()
            return
        self._hand_out(waits=timeout is None)
        if self._hearing:
            # Called by a `done`: the caller below has yet to hear from the processes that it found ready, once each.
            return
        self._hearing = True
        try:
            self._hear(timeout)
        finally:
            self._hearing = False
        self._hand_out(waits=False)

    def _hear(self, timeout: float | None) -> None:
        for key, _ in self._links.select(timeout):
            worker: _Worker = key.data
            try:
                failure: Failure | None = worker.link.recv()
            except (EOFError, OSError):
                self._fail_dead(worker)
            job = worker.jobs.popleft()
            self._finish(job, failure)

    def _hand_out(self, waits: bool) -> None:
        """Hand out tasks, in order, while a process has room for one; `waits`: even if images are still being copied."""
        while self._waiting:
            worker = min(self._workers, key=lambda candidate: len(candidate.jobs))
            copying = self._waiting[0].copying
            if len(worker.jobs) == QUEUE_DEPTH or not (waits or copying is None or copying.done()):
                return
            job = self._waiting.popleft()
            _await_copy(job)
            worker.jobs.append(job)
            try:
                worker.link.send(job.task)
            except OSError:
                self._fail_dead(worker)

    def _run_here(self) -> None:
        while self._waiting:
            job = self._waiting.popleft()
            self._finish(job, run(job.task, self._memory))

    def _finish(self, job: _Job, failure: Failure | None) -> None:
        if failure is not None:
            self._fail(_describe(failure, job.path), failure.trace)
        if job.slot is not None:
            self._free.append(job.slot)
        if job.done is not None:
            job.done()

    def _fail_dead(self, worker: _Worker) -> NoReturn:
        with contextlib.suppress(subprocess.TimeoutExpired):
            worker.process.wait(_END_TIMEOUT)
        code = worker.process.returncode
        how = f"was ended by {signal.Signals(-code).name}" if code and code < 0 else f"ended with exit code {code}"
        what = f"while it wrote {worker.jobs[0].path}" if worker.jobs else "while it had nothing to do"
        self._fail(OutputError(f"a writer process {how} {what}; if memory ran out, set bake.writers to a smaller number"), "")

    def _fail(self, error: OutputError, trace: str) -> NoReturn:
        if trace:
            error.add_note(trace)
        self._failure = error
        raise error

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._ended:
            raise OutputError("the writer processes have ended; make a new pool")


def _describe(failure: Failure, path: Path) -> OutputError:
    if failure.system is None:
        return OutputError(f"cannot write {path}: {failure.error}")
    code, reason, name = failure.system
    return output_error(path, OSError(code, reason, name or str(path)))


def _copy(targets: Sequence[np.ndarray], images: Sequence[np.ndarray]) -> None:
    """Copy images; other threads may run meanwhile."""
    for target, image in zip(targets, images, strict=True):
        np.copyto(target, image)


def _await_copy(job: _Job) -> None:
    if job.copying is not None:
        job.copying.result()


def _shared_memory(size: int) -> tuple[int, mmap.mmap]:
    """Memory without a name, as an open file handle and mapped. Unlike /dev/shm, its size is not limited in containers."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("synpick-warp")
    else:
        with tempfile.TemporaryFile() as file:
            handle = os.dup(file.fileno())
    os.ftruncate(handle, size)
    return handle, mmap.mmap(handle, size)


def _start(memory: int, held: tuple[int, ...]) -> _Worker:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        process = subprocess.Popen(
            (sys.executable, "-P", "-c", _WORKER, str(theirs.fileno()), str(memory)),
            stdin=subprocess.DEVNULL,
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": paths},
            pass_fds=(theirs.fileno(), memory, *held),
            process_group=0,  # A terminal's Ctrl-C goes to the bake alone, even before the process can ignore it.
        )
        return _Worker(process, Connection(ours.detach()))
