"""Writer process pool: bounded queues with back-pressure, images handed over in shared memory, errors raised in the caller."""

import mmap
import os
import subprocess
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.errors import DatasetError, OutputError, SynpickError
from synpick_warp.exporters.writing.files import output_error
from synpick_warp.system.processes import pool
from synpick_warp.system.processes.shared_memory import SharedArray, SharedSlots

NICENESS = 5
"""Niceness increment of the writer processes (nice(2)). On saturated cores the bake, which feeds them and the GPU, gets three times the CPU
share of a writer. A larger increment starves writers beside other CPU-bound programs, and the bake then waits for them."""
QUEUE_DEPTH = 4
"""Tasks in flight per process, including the running one: enough to bridge the time in which the bake prepares the next batch."""
MAX_WAITING = 4096
"""Back-pressure of tasks without images: most that wait for a process, so that a list of millions is not held in memory."""
TASKS_PER_POLL = 4
"""Tasks that are submitted before results are asked for: asking takes half as long as submitting one."""
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
    affinity: int | None = None
    """Tasks of equal numbers are run by the same process, if that is not busier than others: it may have cached parts of their files."""


def _call(function: Callable[..., None], images: tuple[SharedArray, ...], arguments: tuple[Any, ...], memory: mmap.mmap) -> None:
    """Task of a process: call `function(*images, *arguments)`."""
    function(*(image.map(memory) for image in images), *arguments)


@dataclass(eq=False)
class _QueuedTask:
    """Submitted task."""

    call: Callable[[mmap.mmap], None]
    path: Path
    on_done: Callable[[], None] | None
    slot: int | None
    """Index of the slot that holds its images; None: it has no images."""
    copying: Future[None] | None
    """The thread's copy of the images in progress; None: they are in place."""
    affinity: int | None


class WriterPool:
    """Pool of writer processes with back-pressure. As a context manager it closes after success and aborts after an error.

    The processes are fresh interpreters, and the shared memory is anonymous, so nothing leaks however the bake ends.
    """

    def __init__(self, processes: int, slot_bytes: int, *inherited_handles: int) -> None:
        """`processes`: number of processes; 0: tasks run in the calling process. `slot_bytes`: maximum size of the images of one task, see
        `shared_bytes` [B]. `inherited_handles`: file handles that the processes keep open until they exit, such as one that holds a lock.
        Raises OutputError if memory or processes cannot be allocated."""
        self._waiting: deque[_QueuedTask] = deque()
        self._running: dict[pool.TaskFuture, _QueuedTask] = {}
        self._answered: deque[pool.TaskFuture] = deque()
        self._failure: SynpickError | None = None
        self._ended = False
        self._finishing = False
        copy_threads = processes // PROCESSES_PER_COPY_THREAD
        try:
            self._slots = SharedSlots(max(1, processes * QUEUE_DEPTH), slot_bytes, copy_threads if copy_threads > 1 else 0)
        except OSError as error:
            raise OutputError(f"no shared memory for {processes} writer processes: {error}; set bake.writers lower") from error
        handle = self._slots.handle
        setup = partial(_open_slots, handle, NICENESS if processes else 0)
        try:
            self._pool = pool.WorkerPool(
                pool.WorkerProgram(setup, "writer process", "bake.writers", (handle,), inherited_handles), processes
            )
        except (pool.ProcessError, OSError) as error:
            self._slots.close()
            raise OutputError(str(error)) from error
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
        """Submit tasks and return when all their images are copied. Blocks while no slot of shared memory is free, or more than MAX_WAITING
        tasks wait (back-pressure).

        Threads copy the images of earlier tasks while the next one is prepared, so pass tasks that are costly to prepare as a generator.
        Raises DatasetError if a task read a damaged file, and OutputError if one of these or an earlier task failed, or a process died.
        """
        self._check()
        submitted: list[_QueuedTask] = []
        for index, task in enumerate(tasks):
            slot = self._take_slot() if task.images else None
            images, copying = ((), None) if slot is None else self._slots.put(task.images, slot)
            call = partial(_call, task.function, images, task.arguments)
            submitted.append(_QueuedTask(call, task.path, task.on_done, slot, copying, task.affinity))
            self._waiting.append(submitted[-1])
            if index % TASKS_PER_POLL == 0:
                self._progress(0.0)
            while len(self._waiting) > MAX_WAITING and not self._finishing:
                self._progress(None)
        for queued in submitted:
            _await_copy(queued)
        self._progress(0.0)

    def pids(self) -> tuple[int, ...]:
        """Process ids of the writers."""
        return self._pool.pids()

    def poll(self) -> None:
        """Dispatch tasks and process results without blocking. Raises like `submit`."""
        self._check()
        self._progress(0.0)

    def wait(self) -> None:
        """Block until every task is done. Raises like `submit`."""
        self._check()
        self._progress(0.0)
        while self._waiting or self._running:
            self._progress(None)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Block until a condition holds that callbacks make true, or no task is left. Raises like `submit`."""
        self._check()
        while not condition() and (self._waiting or self._running):
            self._progress(None)

    def close(self) -> None:
        """Wait until every task is done, then stop the processes. Raises like `submit`; the processes stop in any case."""
        if self._ended:
            return
        try:
            self.wait()
            self._pool.end()
        except (OSError, subprocess.TimeoutExpired) as error:
            raise OutputError(f"a writer process did not end: {error}") from error
        finally:
            self.abort()

    def abort(self) -> None:
        """Kill the processes. Never raises."""
        self._ended = True
        self._pool.kill()
        self._waiting.clear()
        self._running.clear()
        self._answered.clear()
        self._slots.close()

    def __enter__(self) -> "WriterPool":
        return self

    def __exit__(self, exception: type[BaseException] | None, *_: object) -> None:
        if exception is None:
            self.close()
        else:
            self.abort()

    def _take_slot(self) -> int:
        """Take a free slot of shared memory; waits for a task to end if none is free."""
        while not self._slots.free:
            self._progress(None)
        return self._slots.free.pop()

    def _progress(self, timeout: float | None) -> None:
        """Dispatch tasks and process results; a timeout of None blocks until at least one result arrives."""
        try:
            self._dispatch(blocking=timeout is None)
            if self._finishing:
                return  # A call of `on_done`: the outer call goes on with the results.
            self._answered += self._pool.receive(0.0 if self._answered else timeout)
            self._finish_answered()
            self._dispatch(blocking=False)
        except pool.DeadProcessError as death:
            activity = "while it had nothing to do"
            if death.task is not None:  # The task that could not be sent still waits.
                activity = f"while it wrote {(self._running.get(death.task) or self._waiting[0]).path}"
            self._failure = OutputError(f"a writer process {death.how} {activity}; {death.remedy}")
            raise self._failure from death

    def _dispatch(self, blocking: bool) -> None:
        """Send tasks, in order, while a process has queue capacity; `blocking`: wait for images that are still being copied."""
        while self._waiting:
            copying = self._waiting[0].copying
            if self._pool.load() >= QUEUE_DEPTH or not (blocking or copying is None or copying.done()):
                return
            _await_copy(self._waiting[0])
            future = self._pool.submit(self._waiting[0].call, self._waiting[0].affinity, drain=False)
            self._running[future] = self._waiting.popleft()
            if future.done():  # A task of the calling process.
                self._answered.append(future)

    def _finish_answered(self) -> None:
        """Finish completed tasks in order: release their slots and call their callbacks; store and raise the first error."""
        self._finishing = True
        try:
            while self._answered:
                future = self._answered.popleft()
                queued = self._running.pop(future)
                if future.error is not None:
                    self._failure = _to_error(future.error, queued.path)
                    raise self._failure
                if queued.slot is not None:
                    self._slots.free.append(queued.slot)
                if queued.on_done is not None:
                    queued.on_done()
        finally:
            self._finishing = False

    def _check(self) -> None:
        """Raise the pool's error, or OutputError after its end."""
        if self._failure is not None:
            raise self._failure
        if self._ended:
            raise OutputError("the writer processes have ended; make a new pool")


def _open_slots(handle: int, niceness: int) -> mmap.mmap:
    """Set up a writer process: lower its scheduling priority, and map the shared memory of the images, which is returned."""
    os.nice(niceness)
    return mmap.mmap(handle, 0)


def _to_error(error: Exception, path: Path) -> SynpickError:
    """Pool's error for that of a task; of a programming error, its traceback is kept as a note, which the command line shows."""
    error = pool.portable_error(error)
    if isinstance(error, DatasetError):
        return error
    if isinstance(error, OSError):
        return output_error(path, error)
    kind = "" if isinstance(error, SynpickError | pool.TaskError) else f"{type(error).__name__}: "
    result = OutputError(f"cannot write {path}: {kind}{error}")
    if isinstance(error, pool.TaskError):
        for note in error.__notes__:
            result.add_note(note)
    return result


def _await_copy(queued: _QueuedTask) -> None:
    """Wait until a task's images are copied into shared memory."""
    if queued.copying is not None:
        queued.copying.result()
