"""Prefetching reader: colour, depth and label images of many scenes side by side, decoded ahead; one frame of each scene a step.

Processes decode into shared memory. Threads of this process do where images are few: OpenCV and ISA-L decode without Python's global lock,
but half of a view's time is Python.
"""

from __future__ import annotations

import mmap
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Protocol, Self

import cv2

from synpick_warp.apps.estimation.decoder_pool import DecoderPool, DecodeViews, open_pool
from synpick_warp.apps.estimation.decoding import DecodeJob
from synpick_warp.apps.estimation.scenes import Scene
from synpick_warp.stages.pose.batch import RgbdBatch
from synpick_warp.system.processes.pool import TaskFuture

AHEAD = 2
"""Steps that are decoded ahead of the one in use."""
BYTES_PER_PIXEL = 6
"""Of a view in a `RgbdBatch`: colour, depth and label."""
DEPTHS = {"clean": "depth", "sensor": "depth_sensor"}
"""Choices of depth images, and the folders they are in."""
MAX_VIEWS_PER_TASK = 8
"""Views of a message to a process: enough to make its cost small."""
_TASKS_PER_PROCESS = 2
"""Messages of a step per process, if it has enough views: small ones at the end keep all processes busy."""


class SceneReader:
    """Reader of scenes of equal image size; iterate over its steps within `with`."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        depth: str = "clean",
        *,
        mask_seed: int | None = None,
        threads: int = 1,
        ahead: int = AHEAD,
        pool: DecoderPool | None = None,
    ) -> None:
        """
        Args:
            scenes: Scenes that are read side by side.
            depth: Key of DEPTHS.
            mask_seed: Seed of mask errors; None: exact masks.
            threads: Number of decoding processes, or of threads if there are few images.
            ahead: Steps that are decoded ahead.
            pool: Processes that decode, instead of own ones; the caller closes it.

        Raises:
            ProcessError: Processes cannot be started.
        """
        self.scenes = tuple(scenes)
        self.steps = max((len(scene) for scene in scenes), default=0)
        self._job = DecodeJob(self.scenes, DEPTHS[depth], mask_seed, min(self.steps, 1 + ahead))
        self._own_pool = open_pool(threads, sum(map(len, scenes))) if pool is None else None
        pool = pool or self._own_pool
        self._source: _Source = _Threads(self._job, threads) if pool is None else _Processes(self._job, pool)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._source.close()
        if self._own_pool is not None:
            self._own_pool.kill()

    def __iter__(self) -> Iterator[RgbdBatch]:
        """Batches of step 0, 1, ...; view v shows the step's frame of scene v, or is zero in all images if that scene has ended.

        Labels show the instances that are asked; others are 0, as is everything else that is no instance.

        The arrays of a batch are used again: they are valid until the next batch is taken.

        Raises:
            DatasetError: An image or mask is missing or damaged, or has another size.
            ProcessError: A process died, or there is no memory.
        """
        batches = self._source.open()
        pending: deque[Sequence[_Future]] = deque()
        for step in range(self.steps):
            # The batch of the last step is free from now on.
            for ahead in range(step + len(pending), min(self.steps, step + len(batches))):
                pending.append(self._source.submit(ahead % len(batches), ahead))
            for future in pending.popleft():
                self._source.wait(future)
            yield batches[step % len(batches)]

    def check(self, step: int) -> None:
        """Read the views of one step, so that missing or damaged images are found early.

        Raises:
            DatasetError: See `__iter__`.
        """
        batch = self._allocate()
        for view in range(len(self.scenes)):
            self._fill(batch, view, step)

    def _allocate(self) -> RgbdBatch:
        """Allocate a batch in ordinary memory."""
        return _allocate(self._job)[0]

    def _fill(self, batch: RgbdBatch, view: int, step: int) -> None:
        """Decode view `view` of a step into a batch."""
        self._job.fill_view(batch, view, step)


_Future = Future[Any] | TaskFuture
"""Result of a task to come."""


class _Source(Protocol):
    """Protocol of a decoder that fills batches in the background: threads, or processes over shared memory."""

    def open(self) -> list[RgbdBatch]:
        """Allocate the batches of the ring, and return them."""
        ...

    def submit(self, batch: int, step: int) -> Sequence[_Future]:
        """Begin to decode a step into a batch; returns the tasks' results to come."""
        ...

    def wait(self, future: Any) -> None:
        """Block until a task is done; raises its error."""
        ...

    def close(self) -> None:
        """Stop, and give back what it holds; batches must not be used after it."""
        ...


class _Threads:
    """`_Source` within this process: a view is a task."""

    def __init__(self, job: DecodeJob, threads: int) -> None:
        self._job, self._batches = job, []
        self._pool = ThreadPoolExecutor(max(1, threads), "read")
        # Threads decode whole images each; OpenCV's own would only compete with them.
        cv2.setNumThreads(1)

    def open(self) -> list[RgbdBatch]:
        """Allocate the batches in ordinary memory. See `_Source`."""
        self._batches = _allocate(self._job)
        return self._batches

    def submit(self, batch: int, step: int) -> list[Future[Any]]:
        """Begin to decode a step, a task for each view. See `_Source`."""
        return [self._pool.submit(self._job.fill_view, self._batches[batch], view, step) for view in range(len(self._job.scenes))]

    def wait(self, future: Any) -> None:
        """Block until a task is done; raises its error. See `_Source`."""
        future.result()

    def close(self) -> None:
        """Drop the tasks that have not begun, and wait for the others. See `_Source`."""
        self._pool.shutdown(wait=True, cancel_futures=True)


class _Processes:
    """`_Source` in other processes: a few views are a task."""

    def __init__(self, job: DecodeJob, pool: DecoderPool) -> None:
        self._job, self._pool = job, pool
        self._opening: list[TaskFuture] = []

    def open(self) -> list[RgbdBatch]:
        """Map the batches in shared memory, and announce the job to the workers. See `_Source`."""
        batches, self._opening = self._pool.open_job(self._job)
        return batches

    def submit(self, batch: int, step: int) -> list[TaskFuture]:
        """Begin to decode a step, in tasks of several neighbouring views; returns also what `open` left to wait for. See `_Source`."""
        views = len(self._job.scenes)
        size = max(1, min(MAX_VIEWS_PER_TASK, -(-views // (_TASKS_PER_PROCESS * len(self._pool)))))
        futures, self._opening = self._opening, []
        # The same views go to the same process if it is free: it has read the index of their shards.
        for index, first in enumerate(range(0, views, size)):
            futures.append(self._pool.submit(DecodeViews(batch, step, first, min(views, first + size)), affinity=index))
        return futures

    def wait(self, future: Any) -> None:
        """Block until a task is done, while other answers are taken in; raises its error. See `_Source`."""
        self._pool.wait(future)

    def close(self) -> None:
        """Leave the pool running; tasks that it still decodes are not waited for. See `_Source`."""


def _allocate(job: DecodeJob) -> list[RgbdBatch]:
    """Batches of a job in memory of this process."""
    return job.new_batches(mmap.mmap(-1, job.memory_bytes()))
