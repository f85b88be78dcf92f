"""Writer process pool: bounded queues with back-pressure, images handed over in shared memory, errors raised in the caller."""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
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
from synpick_warp.exporters.writing.worker import Failure, SharedImage, TaskMessage, run_task
from synpick_warp.system.descriptors import duplicate_above_streams, open_standard_descriptors

_WORKER = "from synpick_warp.exporters.writing.worker import main; main()"
"""Program of a writer process: imported, not run as `__main__`, so that pickled tasks name the module's own classes."""
QUEUE_DEPTH = 4
"""Tasks in flight per process, including the running one: enough to bridge the time in which the bake prepares the next batch."""
PROCESSES_PER_COPY_THREAD = 4
"""Writer processes per thread that copies images into shared memory: one core cannot copy as fast as many cores write."""
_ALIGNMENT = 64
"""Images start at a multiple of a cache line [B]."""
_END_TIMEOUT = 10.0
"""How long an idle process may take to exit [s]."""
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
"""The processes are the parallelism: libraries start no threads within them."""


@dataclass(frozen=True, eq=False)
class WriteTask:
    """A task for a writer process: the call `function(*images, *arguments)`."""

    function: Callable[..., None]
    """A top-level function of a module that imports quickly; it is pickled by name."""
    images: Sequence[np.ndarray]
    """Copied into shared memory before the submitting call returns."""
    arguments: tuple[Any, ...]
    """Pickled; keep them small."""
    path: Path
    """The file or folder that the task writes, for error messages."""
    on_done: Callable[[], None] | None = None
    """Callback after success, run in the caller's thread by a later call of the pool. It may submit tasks without images."""


@dataclass(eq=False)
class _QueuedTask:
    """A submitted task with its slot of shared memory."""

    message: TaskMessage
    path: Path
    on_done: Callable[[], None] | None
    slot: int | None
    """Index of the slot that holds its images; None: it has no images."""
    copying: Future[None] | None
    """The thread's copy of the images in progress; None: they are in place."""


@dataclass(eq=False)
class _Worker:
    process: subprocess.Popen[bytes]
    link: Connection
    tasks: deque[_QueuedTask] = field(default_factory=deque)
    """Tasks sent to the process and not yet answered, in order."""


def shared_bytes(sizes: Iterable[int]) -> int:
    """Shared memory that images of these sizes take, with alignment [B]."""
    return sum(-(-size // _ALIGNMENT) * _ALIGNMENT for size in sizes)


class WriterPool:
    """Pool of writer processes with back-pressure. As a context manager it closes after success and aborts after an error.

    Each process is a fresh interpreter started by `subprocess`: not forked, because CUDA and threads do not survive a fork, and not
    spawned by `multiprocessing`, which would import the main script again, and with it the whole simulator (and fail for scripts
    without `if __name__ == "__main__":`). The shared memory is anonymous, so nothing leaks however the bake ends.
    """

    def __init__(self, processes: int, slot_bytes: int, inherited_handle: int | None = None) -> None:
        """
        Args:
            processes: Number of processes; 0: tasks run in the calling process.
            slot_bytes: Maximum size of the images of one task, see `shared_bytes` [B].
            inherited_handle: A file handle that the processes keep open until they exit, such as one that holds a lock.

        Raises:
            OutputError: Memory or processes cannot be allocated.
        """
        open_standard_descriptors()
        self._slot_bytes = -(-max(slot_bytes, 1) // mmap.PAGESIZE) * mmap.PAGESIZE
        slots = max(1, processes * QUEUE_DEPTH)
        self._free = list(range(slots))
        self._waiting: deque[_QueuedTask] = deque()
        self._workers: list[_Worker] = []
        self._links = selectors.DefaultSelector()
        self._failure: OutputError | None = None
        self._ended = False
        self._receiving = False
        self._copy_threads = ThreadPoolExecutor(max(1, processes // PROCESSES_PER_COPY_THREAD))
        self._copies_inline = processes < 2 * PROCESSES_PER_COPY_THREAD
        try:
            handle, self._memory = _allocate_shared_memory(slots * self._slot_bytes)
        except OSError as error:
            raise OutputError(f"no shared memory for {processes} writer processes: {error}; set bake.writers lower") from error
        try:
            for _ in range(processes):
                worker = _start_worker(handle, () if inherited_handle is None else (inherited_handle,))
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
        on_done: Callable[[], None] | None = None,
    ) -> None:
        """Submit one `WriteTask` made of these parts; see `submit_all`."""
        self.submit_all((WriteTask(function, images, arguments, path, on_done),))

    def submit_all(self, tasks: Iterable[WriteTask]) -> None:
        """Submit tasks and return when all their images are copied. Blocks while no slot of shared memory is free (back-pressure).

        Threads copy the images of earlier tasks while the next one is prepared, so pass tasks that are costly to prepare as a generator.

        Raises:
            OutputError: One of these or an earlier task failed, or a process died.
        """
        self._check()
        submitted: list[_QueuedTask] = []
        for task in tasks:
            slot = self._take_slot() if task.images else None
            places, copying = self._copy_to_slot(task.images, slot)
            message = TaskMessage(task.function, places, task.arguments)
            submitted.append(_QueuedTask(message, task.path, task.on_done, slot, copying))
            self._waiting.append(submitted[-1])
            self._progress(0.0)
        for queued in submitted:
            _await_copy(queued)
        self._progress(0.0)

    def pids(self) -> tuple[int, ...]:
        """Process ids of the writers."""
        return tuple(worker.process.pid for worker in self._workers)

    def poll(self) -> None:
        """Dispatch tasks and process results without blocking. Raises like `submit`."""
        self._check()
        self._progress(0.0)

    def wait(self) -> None:
        """Block until every task is done. Raises like `submit`."""
        self._check()
        self._progress(0.0)
        while self._waiting or any(worker.tasks for worker in self._workers):
            self._progress(None)

    def close(self) -> None:
        """Wait until every task is done, then stop the processes. Raises like `submit`; the processes stop in any case."""
        if self._ended:
            return
        try:
            self.wait()
            for worker in self._workers:
                _send(worker.link, None)
            for worker in self._workers:
                worker.process.wait(_END_TIMEOUT)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise OutputError(f"a writer process did not end: {error}") from error
        finally:
            self.abort()

    def abort(self) -> None:
        """Kill the processes. Never raises."""
        self._ended = True
        for worker in self._workers:
            worker.process.kill()
            worker.process.wait()
            worker.link.close()
        self._workers.clear()
        self._waiting.clear()
        self._links.close()
        self._copy_threads.shutdown()
        with contextlib.suppress(BufferError):
            self._memory.close()

    def __enter__(self) -> WriterPool:
        return self

    def __exit__(self, exception: type[BaseException] | None, *_: object) -> None:
        if exception is None:
            self.close()
        else:
            self.abort()

    def _take_slot(self) -> int:
        while not self._free:
            self._progress(None)
        return self._free.pop()

    def _copy_to_slot(self, images: Sequence[np.ndarray], slot: int | None) -> tuple[tuple[SharedImage, ...], Future[None] | None]:
        """Copy images into a slot of shared memory; returns their places, and the copy in progress if a thread makes it."""
        if slot is None:
            return (), None
        if (size := shared_bytes(image.nbytes for image in images)) > self._slot_bytes:
            raise ValueError(f"images of {size} bytes exceed the {self._slot_bytes} of a slot of this pool")
        offset = slot * self._slot_bytes
        places: list[SharedImage] = []
        for image in images:
            places.append(SharedImage(offset, image.shape, image.dtype.str))
            offset += shared_bytes((image.nbytes,))
        targets = [place.map(self._memory) for place in places]
        if self._copies_inline:
            _copy(targets, images)
            return tuple(places), None
        return tuple(places), self._copy_threads.submit(_copy, targets, images)

    def _progress(self, timeout: float | None) -> None:
        """Dispatch tasks and process results; a timeout of None blocks until at least one result arrives."""
        if not self._workers:
            self._run_inline()
            return
        self._dispatch(blocking=timeout is None)
        if self._receiving:
            # Reentrant call from `on_done`: the outer call has yet to receive one result from each link it found ready.
            return
        self._receiving = True
        try:
            self._receive_results(timeout)
        finally:
            self._receiving = False
        self._dispatch(blocking=False)

    def _receive_results(self, timeout: float | None) -> None:
        for key, _ in self._links.select(timeout):
            worker: _Worker = key.data
            try:
                failure: Failure | None = worker.link.recv()
            except (EOFError, OSError):
                self._fail_dead_worker(worker)
            self._finish(worker.tasks.popleft(), failure)

    def _dispatch(self, blocking: bool) -> None:
        """Send tasks, in order, while a process has queue capacity; `blocking`: wait for images that are still being copied."""
        while self._waiting:
            worker = min(self._workers, key=lambda candidate: len(candidate.tasks))
            copying = self._waiting[0].copying
            if len(worker.tasks) == QUEUE_DEPTH or not (blocking or copying is None or copying.done()):
                return
            queued = self._waiting.popleft()
            _await_copy(queued)
            worker.tasks.append(queued)
            try:
                _send(worker.link, queued.message)
            except OSError:
                self._fail_dead_worker(worker)

    def _run_inline(self) -> None:
        while self._waiting:
            queued = self._waiting.popleft()
            self._finish(queued, run_task(queued.message, self._memory))

    def _finish(self, queued: _QueuedTask, failure: Failure | None) -> None:
        if failure is not None:
            self._fail(_to_output_error(failure, queued.path), failure.trace)
        if queued.slot is not None:
            self._free.append(queued.slot)
        if queued.on_done is not None:
            queued.on_done()

    def _fail_dead_worker(self, worker: _Worker) -> NoReturn:
        with contextlib.suppress(subprocess.TimeoutExpired):
            worker.process.wait(_END_TIMEOUT)
        code = worker.process.returncode
        # The kernel's out-of-memory killer sends SIGKILL; any other end has left its reason on the standard error stream.
        remedy = "see its message above, if any, and please report it"
        if code == -signal.SIGKILL:
            remedy = "if memory ran out, set bake.writers to a smaller number"
        how = f"was ended by {signal.Signals(-code).name}" if code and code < 0 else f"ended with exit code {code}"
        activity = f"while it wrote {worker.tasks[0].path}" if worker.tasks else "while it had nothing to do"
        self._fail(OutputError(f"a writer process {how} {activity}; {remedy}"), "")

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


def _to_output_error(failure: Failure, path: Path) -> OutputError:
    if failure.system is None:
        return OutputError(f"cannot write {path}: {failure.error}")
    code, reason, name = failure.system
    return output_error(path, OSError(code, reason, name or str(path)))


def _copy(targets: Sequence[np.ndarray], images: Sequence[np.ndarray]) -> None:
    """Copy images into shared memory; NumPy releases the interpreter lock meanwhile."""
    for target, image in zip(targets, images, strict=True):
        np.copyto(target, image)


def _await_copy(queued: _QueuedTask) -> None:
    if queued.copying is not None:
        queued.copying.result()


def _send(link: Connection, message: TaskMessage | None) -> None:
    """Send a message as bytes: `Connection.send` keeps a view of a BytesIO, on which CPython 3.12.1 crashes in a garbage collection if
    the send fails and the error is part of a reference cycle."""
    link.send_bytes(pickle.dumps(message))


def _allocate_shared_memory(size: int) -> tuple[int, mmap.mmap]:
    """Allocate anonymous shared memory (memfd): file handle and mapping. Unlike /dev/shm, containers do not limit its size."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("synpick-warp")
    else:
        with tempfile.TemporaryFile() as file:
            handle = os.dup(file.fileno())
    os.ftruncate(handle, size)
    return handle, mmap.mmap(handle, size)


def _start_worker(memory: int, inherited: tuple[int, ...]) -> _Worker:
    """Start a process. Its standard output is the null device: nothing is printed there but by mistake, and it may be full or closed."""
    ours, theirs = socket.socketpair()
    with ours, theirs, contextlib.ExitStack() as copies:
        # A lock that was taken while a standard stream was closed has that stream's number.
        passed = tuple(map(duplicate_above_streams, inherited))
        for handle in passed:
            copies.callback(os.close, handle)
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        process = subprocess.Popen(
            (sys.executable, "-P", "-c", _WORKER, str(theirs.fileno()), str(memory)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=None if sys.__stderr__ is not None else subprocess.DEVNULL,
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": paths},
            pass_fds=(theirs.fileno(), memory, *passed),
            process_group=0,  # Ctrl-C in a terminal reaches the bake alone, even before the process ignores it.
        )
        return _Worker(process, Connection(ours.detach()))
