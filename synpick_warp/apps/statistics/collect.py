"""Streaming pass over a data set: scenes one at a time, spread over processes, each of which holds its counts only."""

from __future__ import annotations

import resource
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

from msgspec import UNSET

from synpick_warp.apps.statistics import columns
from synpick_warp.apps.statistics.counts import Block, Counts, Group
from synpick_warp.dataset.annotations import check_content
from synpick_warp.dataset.bop.arrays import read_arrays
from synpick_warp.dataset.commit.manifest import episode_entry
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
    """Task of a worker: a scene with its number of frames, and the frames whose depth image is read."""

    episode: int
    camera: int
    frames: int
    depth_frames: Sequence[int] = ()


class Finished(NamedTuple):
    """Counts of a process, and its peak memory [B]."""

    counts: Counts
    memory: int


@dataclass
class Collected:
    """All counts of a data set."""

    counts: Counts = field(default_factory=Counts)
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
        found.counts.add(read_episode(data_set, episode))
        if _has_images(data_set, episode):
            tasks += [SceneTask(episode, each, len(data_set[episode].images(each))) for each in data_set[episode].cameras]
        else:
            without += 1
    found.missing += _count_rest(data_set, found.counts)
    if not found.counts.groups():
        raise DatasetError(f"{data_set.folder} has no episode to count; finish the bake first")
    if without:
        found.missing.append(f"{without:,} episodes have no images: they count as episodes only; bake with --formats bop or shards")
    there, planned = len(data_set), data_set.planned
    if there < planned:
        found.missing.append(
            f"{planned - there:,} of {planned:,} planned episodes are not baked; the command that started the bake resumes it"
        )
    found.views = sum(task.frames for task in tasks)
    processes = min(threads, found.views // VIEWS_PER_PROCESS, len(tasks))
    sampled = _sample_depth(tasks, depth_views)
    for part in _count(data_set, sampled, processes, lambda done: report and report("views", done, found.views)):
        found.counts.merge(part.counts)
        found.memory += part.memory
    found.memory += _peak_memory() if processes > 1 else 0
    return found


def read_facts(data_set: DataSet, episode: int) -> columns.EpisodeFacts:
    """Read the manifest row of an episode; raises DatasetError if it is damaged."""
    return check_content(data_set[episode].row, columns.EpisodeFacts, data_set.folder / f"{episode_entry(episode)}.json")


def read_episode(data_set: DataSet, episode: int) -> Iterator[Block]:
    """Tables of an episode; raises DatasetError if its manifest entry is damaged."""
    row, source = read_facts(data_set, episode), data_set.folder / f"{episode_entry(episode)}.json"
    attempts = [check_content(attempt, columns.AttemptFacts, source) for attempt in data_set[episode].attempts]
    group = Group(data_set.split_of(episode), row.mode)
    return columns.episode_blocks(group, row, attempts, data_set.config.suction if attempts else None)


def read_scene(data_set: DataSet, task: SceneTask) -> Iterator[Block]:
    """Tables of a scene, without images but those of `task.depth_frames`; of camera 0 also objects over time and light.

    Raises:
        DatasetError: The data set has no images of it, or a file is missing or damaged.
    """
    episode, camera = task.episode, task.camera
    group = Group(data_set.split_of(episode), read_facts(data_set, episode).mode)
    files = data_set.scene_files(episode, camera)
    images = data_set[episode].images(camera) if files.complete else files.frames()
    scene = read_arrays(files, images, columns.CAMERA, whole=True)
    yield from columns.scene_blocks(group, scene, files.place)
    if camera == 0:
        if data_set.period is not None:
            yield from columns.frame_blocks(group, scene, data_set.period)
        if scene.cameras and (light := scene.cameras[0].light) is not UNSET:
            yield from columns.light_blocks(light)
    for frame in task.depth_frames if files.has("depth") else ():
        if (scale := scene.cameras[frame].depth_scale) is not UNSET:
            yield from columns.depth_blocks(files.typed_image("depth", images[frame], None, "uint16"), float(scale))


def _count_rest(data_set: DataSet, counts: Counts) -> Iterator[str]:
    """Count windows of piles at rest in the step logs of up to REST_EPISODES episodes; yields a sentence for each that cannot be read."""
    for episode in _spread(list(data_set), REST_EPISODES) if data_set.found is None and data_set.has_store else ():
        try:
            counts.add(columns.rest_blocks(data_set[episode], data_set.config.physics.step))
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


def _sample_depth(tasks: Sequence[SceneTask], count: int) -> Iterator[SceneTask]:
    """Tasks with the frames of `count` views that are spread evenly over all views."""
    chosen, begin = _spread(range(sum(task.frames for task in tasks)), count), 0
    for task in tasks:
        own = chosen[bisect_left(chosen, begin) : bisect_left(chosen, begin + task.frames)]
        yield task._replace(depth_frames=tuple(place - begin for place in own))
        begin += task.frames


def _count(data_set: DataSet, tasks: Iterator[SceneTask], processes: int, report: Callable[[int], None]) -> Iterator[Finished]:
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
        self._counts = Counts()

    def add(self, task: SceneTask) -> int:
        """Task: count a scene; returns its number of views."""
        self._counts.add(read_scene(self._data_set, task))
        return task.frames

    def finish(self) -> Finished:
        """Task: return all that was counted, and the peak memory of the process."""
        return Finished(self._counts, _peak_memory())


def _open_counter(folder: Path) -> _Counter:
    """Open the data set in a worker process, with empty counters."""
    return _Counter(DataSet(folder))
