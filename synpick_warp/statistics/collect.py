"""Streaming pass over a data set: scenes one at a time, spread over processes, each of which holds its counts only."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import NamedTuple, NoReturn

from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError, SynpickError
from synpick_warp.progress import Report
from synpick_warp.statistics.partial import Partial
from synpick_warp.system.descriptors import open_standard_descriptors
from synpick_warp.system.processes import ProcessError, WorkerProcess, send, serve, start_process

VIEWS_PER_PROCESS = 5000
"""Minimum number of views per process: starting one takes the time in which this one counts some 5,000 views."""
_PROGRAM = "from synpick_warp.statistics.collect import main; main()"
_AHEAD = 2
"""Unanswered messages per process: one is worked on, the other waits."""
_KIBIBYTE = 1024
"""Unit of `ru_maxrss` on Linux."""


class SceneTask(NamedTuple):
    """A scene to count."""

    episode: int
    camera: int
    frames: int
    depth_frames: tuple[int, ...] = ()


class Finish(NamedTuple):
    """Message: no task follows; the answer is `Finished`."""


class Finished(NamedTuple):
    """What a process has counted, and its peak memory [B]."""

    partial: Partial
    memory: int


@dataclass
class Collected:
    """Counts of a data set."""

    partial: Partial = field(default_factory=Partial)
    views: int = 0
    """Views that were counted."""
    missing: list[str] = field(default_factory=list)
    """What the data set does not have, a sentence each."""
    memory: int = 0
    """Peak memory of all processes together [B]."""


def collect(data_set: DataSet, depth_views: int, threads: int, report: Report | None = None) -> Collected:
    """Count episodes, attempts and the annotations of all scenes.

    Args:
        data_set: The data set, or a split of it.
        depth_views: Number of views whose depth image is read, spread evenly over all views.
        threads: Maximum number of processes.
        report: Receives the progress.

    Raises:
        ConfigError: The settings are missing or damaged.
        DatasetError: There is no episode, or a file is missing or damaged.
        ProcessError: A process died.
    """
    found = Collected()
    tasks, without = [], 0
    for episode in data_set:
        row = found.partial.add_episode(data_set, episode)
        if _has_images(data_set, episode):
            tasks += [SceneTask(episode, camera, row.frames) for camera in data_set[episode].cameras]
        else:
            without += 1
    episodes = found.partial.episodes.groups()
    if not episodes:
        raise DatasetError(f"{data_set.folder} has no episode to count; finish the bake first")
    if without:
        found.missing.append(f"{without:,} episodes have no images: they count as episodes only; bake with --formats bop or shards")
    there, planned = len(data_set), data_set.planned
    if there < planned:
        found.missing.append(
            f"{planned - there:,} of {planned:,} planned episodes are not baked; the command that started the bake resumes it"
        )
    total = sum(task.frames for task in tasks)
    processes = min(threads, total // VIEWS_PER_PROCESS, len(tasks))
    parts = _spread if processes > 1 else _count_here
    for part in parts(data_set, _sample_depth(tasks, depth_views), processes, lambda done: report and report("views", done, total)):
        found.partial.merge(part.partial)
        found.memory += part.memory
    found.memory += 0 if parts is _count_here else _peak_memory()
    found.views = total
    return found


def _has_images(data_set: DataSet, episode: int) -> bool:
    try:
        data_set.scene_files(episode, data_set[episode].cameras[0])
    except DatasetError:
        return False
    return True


def _sample_depth(tasks: Sequence[SceneTask], count: int) -> list[SceneTask]:
    """Tasks with the frames of `count` views that are spread evenly over all views."""
    total = sum(task.frames for task in tasks)
    chosen = sorted({(2 * index + 1) * total // (2 * count) for index in range(count)}) if total else []
    result, begin, place = [], 0, 0
    for task in tasks:
        end, frames = begin + task.frames, []
        while place < len(chosen) and chosen[place] < end:
            frames.append(chosen[place] - begin)
            place += 1
        result.append(task._replace(depth_frames=tuple(frames)))
        begin = end
    return result


def _count_here(data_set: DataSet, tasks: Sequence[SceneTask], _: int, report: Callable[[int], None]) -> Iterator[Finished]:
    """Count in this process."""
    partial, done = Partial(), 0
    for task in tasks:
        partial.add_scene(data_set, task.episode, task.camera, task.depth_frames)
        done += task.frames
        report(done)
    yield Finished(partial, _peak_memory())


def _spread(data_set: DataSet, tasks: Sequence[SceneTask], processes: int, report: Callable[[int], None]) -> Iterator[Finished]:
    """Count in several processes; gives what each one has counted."""
    open_standard_descriptors()
    workers: list[WorkerProcess] = []
    try:
        try:
            workers += [start_process(_PROGRAM) for _ in range(processes)]
        except OSError as error:
            raise ProcessError(f"cannot start {processes} processes: {error}; set --threads lower") from error
        for worker in workers:
            _send(worker, data_set.folder)
        done, left = 0, iter(tasks)
        for worker in workers * _AHEAD:
            _send_next(worker, left)
        while busy := {worker.link: worker for worker in workers if worker.tasks}:
            for link in wait(list(busy)):
                worker = busy[link]  # type: ignore[index]
                answer = _receive(worker)
                if isinstance(answer, Finished):
                    yield answer
                    continue
                done += answer
                report(done)
                _send_next(worker, left)
    finally:
        for worker in workers:
            worker.kill()


def _send_next(worker: WorkerProcess, tasks: Iterator[SceneTask]) -> None:
    """Send the next task; after the last one, ask once for the counts."""
    if Finish() not in worker.tasks:
        _send(worker, next(tasks, Finish()))


def _send(worker: WorkerProcess, message: object) -> None:
    try:
        send(worker.link, message)
    except OSError:
        _fail(worker)
    worker.tasks.append(message)


def _receive(worker: WorkerProcess) -> int | Finished:
    """The next answer: the number of views of a task, or all counts."""
    try:
        answer = worker.link.recv()
    except (EOFError, OSError):
        _fail(worker)
    worker.tasks.popleft()
    if isinstance(answer, Exception):
        raise answer
    return answer


def _fail(worker: WorkerProcess) -> NoReturn:
    how, remedy = worker.describe_end("--threads")
    raise ProcessError(f"a process that counts {how}; {remedy}")


def _peak_memory() -> int:
    """Peak resident memory of this process [B]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIBIBYTE


class _Server:
    """Answers of a process: first comes the folder of the data set, then tasks, then `Finish`."""

    def __init__(self) -> None:
        self._data_set: DataSet | None = None
        self._partial = Partial()

    def answer(self, message: Path | SceneTask | Finish) -> int | Finished | Exception:
        """Number of views that a message has, the counts, or the error."""
        if isinstance(message, Finish):
            return Finished(self._partial, _peak_memory())
        try:
            if isinstance(message, Path):
                self._data_set = DataSet(message)
                return 0
            assert self._data_set is not None
            self._partial.add_scene(self._data_set, message.episode, message.camera, message.depth_frames)
        except SynpickError as error:
            return error
        return message.frames


def main() -> None:
    """Main function of a process."""
    from multiprocessing.connection import Connection

    serve(Connection(int(sys.argv[1])), _Server().answer)
