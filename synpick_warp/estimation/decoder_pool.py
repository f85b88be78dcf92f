"""Decoder process pool: messages go to the least busy process, batches are in shared memory, errors raised in the caller.

Python's global lock lets threads decode some 150 views/s, however many cores there are; processes have one each.
"""

from __future__ import annotations

import os
import pickle
import selectors
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from multiprocessing.reduction import send_handle
from typing import Any, NoReturn, Self

from synpick_warp.estimation.decoder import Answer, Message, OpenJob
from synpick_warp.estimation.decoding import DecodeJob
from synpick_warp.stages.pose.batch import RgbdBatch
from synpick_warp.system.descriptors import open_standard_descriptors
from synpick_warp.system.processes import ProcessError, WorkerProcess, send, start_process
from synpick_warp.system.shared_memory import allocate_shared_memory

_PROGRAM = "from synpick_warp.estimation.decoder import main; main()"
_ENVIRONMENT = {"MALLOC_TRIM_THRESHOLD_": str(64 << 20), "MALLOC_MMAP_THRESHOLD_": str(32 << 20)}
"""glibc's allocator keeps the memory of freed images up to these sizes [B] (mallopt(3)). Otherwise the kernel takes it back, and clears it
for the next image, which is a fifth of a view's time."""
VIEWS_PER_PROCESS = 100
"""Minimum number of views per process: starting one takes 0.3 s of CPU time, which decodes some 100 views of 640 x 360."""
_WINDOW = 2
"""Unanswered messages per process in `map_ordered`; answers are large."""


def open_pool(threads: int, views: int) -> DecoderPool | None:
    """Start a pool sized for a number of views; None: with so few views or threads, reading in the calling process is faster.

    Raises:
        ProcessError: Processes cannot be started.
    """
    processes = min(threads, views // VIEWS_PER_PROCESS)
    return DecoderPool(processes) if processes > 1 else None


class DecoderPool:
    """Pool of decoder processes, for several jobs in turn. As a context manager it ends them; they never outlive this process."""

    def __init__(self, processes: int) -> None:
        """
        Args:
            processes: Number of processes.

        Raises:
            ProcessError: They cannot be started.
        """
        open_standard_descriptors()
        self._workers: list[WorkerProcess] = []
        self._links = selectors.DefaultSelector()
        try:
            for _ in range(processes):
                worker = start_process(_PROGRAM, environment=_ENVIRONMENT)
                self._workers.append(worker)
                self._links.register(worker.link, selectors.EVENT_READ, worker)
        except OSError as error:
            self.close()
            raise ProcessError(f"cannot start {processes} processes to read images: {error}; set --threads lower") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        """Number of processes."""
        return len(self._workers)

    def close(self) -> None:
        """End the processes, also in the middle of a message. Never raises."""
        for worker in self._workers:
            worker.kill()
        self._workers.clear()
        self._links.close()

    def open_job(self, job: DecodeJob) -> tuple[list[RgbdBatch], list[Future[Any]]]:
        """Open a job in all processes; later messages refer to it.

        Returns:
            Its batches, which lie in shared memory, and the answers to come.

        Raises:
            ProcessError: Memory cannot be allocated, or a process died.
        """
        size = job.memory_bytes()
        try:
            handle, memory = allocate_shared_memory(size)
        except OSError as error:
            raise ProcessError(f"no shared memory for images ({size >> 20} MiB): {error}; set --batch lower") from error
        batches = job.new_batches(memory)
        message = pickle.dumps(OpenJob(job.without_truth()))
        futures = []
        try:
            for worker in self._workers:
                try:
                    worker.link.send_bytes(message)
                    send_handle(worker.link, handle, None)
                except OSError:
                    self._fail(worker)
                futures.append(_expect(worker))
        finally:
            os.close(handle)
        return batches, futures

    def submit(self, message: Message, affinity: int = 0) -> Future[Any]:
        """Send a message to the process with the fewest pending answers.

        Args:
            message: The message; it is pickled.
            affinity: Among several such processes, equal numbers choose the same.

        Raises:
            ProcessError: A process died.
        """
        # Answers are taken first, so that a process that waits for its answer to be read takes the message.
        self._receive(0.0)
        count = len(self._workers)
        worker = self._workers[min(range(count), key=lambda index: (len(self._workers[index].tasks), (index - affinity) % count))]
        try:
            send(worker.link, message)
        except OSError:
            self._fail(worker)
        return _expect(worker)

    def map_ordered(self, messages: Iterable[Message]) -> Iterator[Any]:
        """Answers to messages, in order; some are sent ahead. Raises the errors of `wait`."""
        pending: deque[Future[Any]] = deque()
        for message in messages:
            pending.append(self.submit(message))
            if len(pending) >= _WINDOW * len(self):
                yield self.wait(pending.popleft())
        while pending:
            yield self.wait(pending.popleft())

    def wait(self, future: Future[Any]) -> Any:
        """Block until a message is answered; returns the answer.

        Raises:
            SynpickError: What the process raised.
            ProcessError: A process died.
        """
        while not future.done():
            self._receive(None)
        return future.result()

    def _receive(self, timeout: float | None) -> None:
        """Receive available answers; a timeout of None blocks until there is one."""
        for key, _ in self._links.select(timeout):
            worker: WorkerProcess = key.data
            try:
                answer: Answer = worker.link.recv()
            except (EOFError, OSError):
                self._fail(worker)
            future: Future[Any] = worker.tasks.popleft()
            if answer.error is None:
                future.set_result(answer.value)
            else:
                answer.error.add_note(answer.trace)
                future.set_exception(answer.error)

    def _fail(self, worker: WorkerProcess) -> NoReturn:
        how, remedy = worker.describe_end("--threads")
        raise ProcessError(f"a process that reads images {how}; {remedy}")


def _expect(worker: WorkerProcess) -> Future[Any]:
    """Record a sent message; returns its pending answer."""
    future: Future[Any] = Future()
    worker.tasks.append(future)
    return future
