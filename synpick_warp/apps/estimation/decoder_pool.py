"""Decoder process pool: processes read scenes, and decode their images into memory shared with the estimation.

Python's global lock lets threads decode some 150 views/s, however many cores there are; processes have one each.
"""

from __future__ import annotations

import mmap
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from synpick_warp.apps.estimation.decoding import DecodeJob
from synpick_warp.apps.estimation.scenes import Scene, ScenePlan, read_scene
from synpick_warp.dataset.reading import DataSet
from synpick_warp.stages.pose.batch import RgbdBatch
from synpick_warp.system.processes.pool import TaskFuture, WorkerPool, WorkerProgram
from synpick_warp.system.processes.shared_memory import allocate_shared_memory
from synpick_warp.system.processes.worker import ProcessError

_ENVIRONMENT = {"MALLOC_TRIM_THRESHOLD_": str(64 << 20), "MALLOC_MMAP_THRESHOLD_": str(32 << 20)}
"""glibc's allocator keeps the memory of freed images up to these sizes [B] (mallopt(3)). Otherwise the kernel takes it back, and clears it
for the next image, which is a fifth of a view's time."""
VIEWS_PER_PROCESS = 100
"""Minimum number of views per process: starting one takes 0.3 s of CPU time, which decodes some 100 views of 640 x 360."""
SCENES_AHEAD = 2
"""Scenes per process that are read ahead; they are large."""


class Decoder:
    """State of a process: the current job and its batches."""

    def __init__(self) -> None:
        self.job: DecodeJob | None = None
        self.batches: list[RgbdBatch] = []


@dataclass(frozen=True)
class OpenJob:
    """Task: make a job the current one; its batches lie in the shared memory whose file handle comes with the task."""

    job: DecodeJob

    def __call__(self, decoder: Decoder, handle: int) -> None:
        decoder.batches = []  # The last job's memory is given back first.
        try:
            decoder.job, decoder.batches = self.job, self.job.map_batches(mmap.mmap(handle, self.job.memory_bytes()))
        finally:
            os.close(handle)


@dataclass(frozen=True)
class DecodeViews:
    """Task: decode one frame of the job's scenes `first` to `stop - 1` into a batch: view i is scene i, `step` the frame's index in it."""

    batch: int
    step: int
    first: int
    stop: int

    def __call__(self, decoder: Decoder) -> None:
        assert decoder.job is not None
        for view in range(self.first, self.stop):
            decoder.job.fill_view(decoder.batches[self.batch], view, self.step)


@dataclass(frozen=True)
class ReadScene:
    """Task: read the ground truth of a scene of the data set in a folder."""

    folder: Path
    plan: ScenePlan

    def __call__(self, decoder: Decoder) -> Scene:
        return read_scene(_open(self.folder), self.plan)


@cache
def _open(folder: Path) -> DataSet:
    """Open the data set in a worker process, once for all tasks."""
    return DataSet(folder)


class DecoderPool(WorkerPool):
    """Pool of decoder processes, for several jobs in turn. As a context manager it ends them; they never outlive this process."""

    def __init__(self, processes: int) -> None:
        """
        Args:
            processes: Number of processes.

        Raises:
            ProcessError: They cannot be started.
        """
        super().__init__(WorkerProgram(Decoder, "process that reads images", environment=_ENVIRONMENT), processes)

    def open_job(self, job: DecodeJob) -> tuple[list[RgbdBatch], list[TaskFuture]]:
        """Open a job in all processes; later tasks refer to it.

        Returns:
            Its batches, which lie in shared memory, and a future per process, done when it has opened the job.

        Raises:
            ProcessError: Memory cannot be allocated, or a process died.
        """
        size = job.memory_bytes()
        try:
            handle, memory = allocate_shared_memory(size)
        except OSError as error:
            raise ProcessError(f"no shared memory for images ({size >> 20} MiB): {error}; set --batch lower") from error
        try:
            return job.new_batches(memory), self.broadcast(OpenJob(job.without_truth()), handle)
        finally:
            os.close(handle)


def open_pool(threads: int, views: int) -> DecoderPool | None:
    """Start a pool sized for a number of views; None: with so few views or threads, reading in the calling process is faster.

    Raises:
        ProcessError: Processes cannot be started.
    """
    processes = min(threads, views // VIEWS_PER_PROCESS)
    return DecoderPool(processes) if processes > 1 else None
