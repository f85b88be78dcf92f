"""Streaming pass over a data set: scenes one at a time, spread over processes, each of which holds its counts only."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

from synpick_warp.apps.statistics.partial import Partial
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from synpick_warp.system.processes.pool import WorkerPool, WorkerProgram
from synpick_warp.system.progress import Report

VIEWS_PER_PROCESS = 5000
"""Minimum number of views per process: starting one takes the time in which this one counts some 5,000 views."""
REST_EPISODES = 256
"""Episodes whose step log is read, spread evenly: some 2 MB each."""
_DEPTH = 2
"""Unanswered tasks per process: one is worked on, the other waits."""
_KIBIBYTE = 1024
"""Unit of `ru_maxrss` on Linux."""


class SceneTask(NamedTuple):
    """Task of a worker: a scene (episode, camera) with its number of frames, and the frames whose depth image is read."""

    episode: int
    camera: int
    frames: int
    depth_frames: tuple[int, ...] = ()


class Finished(NamedTuple):
    """Counts of a process, and its peak memory [B]."""

    partial: Partial
    memory: int


@dataclass
class Collected:
    """All counts of a data set, views that were counted, sentences on what is missing, and peak memory [B]."""

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
        found.partial.add_episode(data_set, episode)
        if _has_images(data_set, episode):
            tasks += [SceneTask(episode, each, len(data_set[episode].images(each))) for each in data_set[episode].cameras]
        else:
            without += 1
    found.missing += _count_rest(data_set, found.partial)
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
    sampled = _sample_depth(tasks, depth_views)
    for part in _count(data_set, sampled, processes, lambda done: report and report("views", done, total)):
        found.partial.merge(part.partial)
        found.memory += part.memory
    found.memory += _peak_memory() if processes > 1 else 0
    found.views = total
    return found


def _count_rest(data_set: DataSet, partial: Partial) -> Iterator[str]:
    """Count windows of piles at rest in the step logs of up to REST_EPISODES episodes; yields a sentence for each that cannot be read."""
    for episode in _spread(list(data_set), REST_EPISODES) if data_set.found is None and data_set.has_store else ():
        try:
            partial.rest.add_episode(data_set[episode], data_set.config.physics.step)
        except DatasetError as error:
            yield f"the step log of episode {episode} cannot be read: {error}"


def _has_images(data_set: DataSet, episode: int) -> bool:
    """Whether an episode has files of its first camera."""
    try:
        data_set.scene_files(episode, data_set[episode].cameras[0])
    except DatasetError:
        return False
    return True


def _spread(items: Sequence[int], count: int) -> list[int]:
    """Choose `count` items, or all if they are fewer, spread evenly."""
    total = len(items)
    return [items[index] for index in sorted({(2 * index + 1) * total // (2 * count) for index in range(count)})] if total else []


def _sample_depth(tasks: Sequence[SceneTask], count: int) -> list[SceneTask]:
    """Tasks with the frames of `count` views that are spread evenly over all views."""
    chosen = _spread(range(sum(task.frames for task in tasks)), count)
    result, begin, place = [], 0, 0
    for task in tasks:
        end, frames = begin + task.frames, []
        while place < len(chosen) and chosen[place] < end:
            frames.append(chosen[place] - begin)
            place += 1
        result.append(task._replace(depth_frames=tuple(frames)))
        begin = end
    return result


def _count(data_set: DataSet, tasks: Sequence[SceneTask], processes: int, report: Callable[[int], None]) -> Iterator[Finished]:
    """Count scenes in several processes, or with one in the calling process; yields the counts of each."""
    setup = partial(_open_counter, data_set.folder) if processes > 1 else partial(_Counter, data_set)
    with WorkerPool(WorkerProgram(setup, "process that counts"), processes if processes > 1 else 0) as pool:
        done = 0
        for views in pool.map_ordered((partial(_Counter.add, task=task) for task in tasks), depth=_DEPTH):
            done += views
            report(done)
        yield from map(pool.wait, pool.broadcast(_Counter.finish))


def _peak_memory() -> int:
    """Peak resident memory of this process [B]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIBIBYTE


class _Counter:
    """State of a process: a data set, and what the process has counted of it."""

    def __init__(self, data_set: DataSet) -> None:
        self._data_set = data_set
        self._partial = Partial()

    def add(self, task: SceneTask) -> int:
        """Task: count a scene; returns its number of views."""
        self._partial.add_scene(self._data_set, task.episode, task.camera, task.depth_frames)
        return task.frames

    def finish(self) -> Finished:
        """Task: return all that was counted, and the peak memory of the process."""
        return Finished(self._partial, _peak_memory())


def _open_counter(folder: Path) -> _Counter:
    """Open the data set in a worker process, with empty counters."""
    return _Counter(DataSet(folder))
