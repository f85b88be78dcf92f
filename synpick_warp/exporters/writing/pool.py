"""Writer process pool: bounded queues with back-pressure, images handed over in shared memory, errors raised in the caller."""

from __future__ import annotations

import contextlib
import mmap
import os
import selectors
import subprocess
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from synpick_warp.errors import DatasetError, OutputError, SynpickError
from synpick_warp.exporters.writing.files import output_error
from synpick_warp.exporters.writing.worker import Failure, TaskMessage, run_task
from synpick_warp.system.descriptors import open_standard_descriptors
from synpick_warp.system.processes import END_TIMEOUT, WorkerProcess, send, start_process
from synpick_warp.system.shared_memory import SharedArray, allocate_shared_memory, shared_bytes
from synpick_warp.system.threads import COPIES

_WORKER = "from synpick_warp.exporters.writing.worker import main; main()"
"""Program of a writer process."""
QUEUE_DEPTH = 4
"""Tasks in flight per process, including the running one: enough to bridge the time in which the bake prepares the next batch."""
PROCESSES_PER_COPY_THREAD = 4
"""Writer processes per thread that copies images into shared memory: one core cannot copy as fast as many cores write."""


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


class WriterPool:
    """Pool of writer processes with back-pressure. As a context manager it closes after success and aborts after an error.

    The processes are fresh interpreters, and the shared memory is anonymous, so nothing leaks however the bake ends.
    """

    def __init__(self, processes: int, slot_bytes: int, *inherited_handles: int) -> None:
        """
        Args:
            processes: Number of processes; 0: tasks run in the calling process.
            slot_bytes: Maximum size of the images of one task, see `shared_bytes` [B].
            inherited_handles: File handles that the processes keep open until they exit, such as one that holds a lock.

        Raises:
            OutputError: Memory or processes cannot be allocated.
        """
        open_standard_descriptors()
        self._slot_bytes = -(-max(slot_bytes, 1) // mmap.PAGESIZE) * mmap.PAGESIZE
        slots = max(1, processes * QUEUE_DEPTH)
        self._free = list(range(slots))
        self._waiting: deque[_QueuedTask] = deque()
        self._workers: list[WorkerProcess] = []
        self._links = selectors.DefaultSelector()
        self._failure: SynpickError | None = None
        self._ended = False
        self._receiving = False
        self._copy_threads = ThreadPoolExecutor(max(1, processes // PROCESSES_PER_COPY_THREAD), COPIES)
        self._copies_inline = processes < 2 * PROCESSES_PER_COPY_THREAD
        try:
            handle, self._memory = allocate_shared_memory(slots * self._slot_bytes)
        except OSError as error:
            raise OutputError(f"no shared memory for {processes} writer processes: {error}; set bake.writers lower") from error
        try:
            for _ in range(processes):
                worker = start_process(_WORKER, (handle,), inherited_handles)
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
            DatasetError: A task read a damaged file.
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

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Block until a condition holds that callbacks make true, or no task is left. Raises like `submit`."""
        self._check()
        while not condition() and (self._waiting or any(worker.tasks for worker in self._workers)):
            self._progress(None)

    def close(self) -> None:
        """Wait until every task is done, then stop the processes. Raises like `submit`; the processes stop in any case."""
        if self._ended:
            return
        try:
            self.wait()
            for worker in self._workers:
                send(worker.link, None)
            for worker in self._workers:
                worker.process.wait(END_TIMEOUT)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise OutputError(f"a writer process did not end: {error}") from error
        finally:
            self.abort()

    def abort(self) -> None:
        """Kill the processes. Never raises."""
        self._ended = True
        for worker in self._workers:
            worker.kill()
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

    def _copy_to_slot(self, images: Sequence[np.ndarray], slot: int | None) -> tuple[tuple[SharedArray, ...], Future[None] | None]:
        """Copy images into a slot of shared memory; returns their places, and the copy in progress if a thread makes it."""
        if slot is None:
            return (), None
        if (size := shared_bytes(image.nbytes for image in images)) > self._slot_bytes:
            raise ValueError(f"images of {size} bytes exceed the {self._slot_bytes} of a slot of this pool")
        offset = slot * self._slot_bytes
        places: list[SharedArray] = []
        for image in images:
            places.append(SharedArray(offset, image.shape, image.dtype.str))
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
            worker: WorkerProcess = key.data
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
                send(worker.link, queued.message)
            except OSError:
                self._fail_dead_worker(worker)

    def _run_inline(self) -> None:
        while self._waiting:
            queued = self._waiting.popleft()
            self._finish(queued, run_task(queued.message, self._memory))

    def _finish(self, queued: _QueuedTask, failure: Failure | None) -> None:
        if failure is not None:
            self._fail(_to_error(failure, queued.path), failure.trace)
        if queued.slot is not None:
            self._free.append(queued.slot)
        if queued.on_done is not None:
            queued.on_done()

    def _fail_dead_worker(self, worker: WorkerProcess) -> NoReturn:
        how, remedy = worker.describe_end("bake.writers")
        activity = f"while it wrote {worker.tasks[0].path}" if worker.tasks else "while it had nothing to do"
        self._fail(OutputError(f"a writer process {how} {activity}; {remedy}"), "")

    def _fail(self, error: SynpickError, trace: str) -> NoReturn:
        if trace:
            error.add_note(trace)
        self._failure = error
        raise error

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._ended:
            raise OutputError("the writer processes have ended; make a new pool")


def _to_error(failure: Failure, path: Path) -> SynpickError:
    if failure.is_input:
        return DatasetError(failure.error)
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
