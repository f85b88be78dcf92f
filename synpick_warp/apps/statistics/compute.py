"""Statistics of a data set: figures of all groups from counts, beside those of the SynPick paper, whose numbers are in paper.toml.

Counts come from a streaming pass: scenes one at a time, spread over processes, each of which holds its counts only.
"""

import functools
import math
import re
import resource
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET

from synpick_warp.apps.statistics import columns, figures
from synpick_warp.apps.statistics.columns import Block, Counts, Group
from synpick_warp.apps.statistics.figures import Comparison, GroupStatistics, Numbers
from synpick_warp.configs.dataset import split_kind
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.annotations import check_content
from synpick_warp.dataset.bop.arrays import read_arrays
from synpick_warp.dataset.bop.layout import object_names
from synpick_warp.dataset.commit.manifest import episode_entry
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.inputs.files import read_toml
from synpick_warp.system.processes.pool import WorkerPool, WorkerProgram
from synpick_warp.system.progress import Report

VIEWS_PER_PROCESS = 5000
"""Minimum number of views per process: starting one takes the time in which this one counts some 5,000 views."""
REST_EPISODES = 256
"""Episodes whose step log is read, spread evenly: some 2 MB each."""
_DEPTH = 2
"""Tasks in flight per process: one runs, the other is queued."""
_KIBIBYTE = 1024
"""Unit of `ru_maxrss` on Linux."""


class SceneTask(NamedTuple):
    """Task of a worker: a scene with its number of frames, and the frames whose depth image is read."""

    episode: int
    camera: int
    frames: int
    depth_frames: Sequence[int] = ()


@dataclass
class Collected:
    """Counts of a data set."""

    counts: Counts = field(default_factory=Counts)
    views: int = 0
    missing: list[str] = field(default_factory=list)
    """Sentences about data that the data set lacks."""
    memory: int = 0
    """Peak memory of all processes together [B]."""


def collect(data_set: DataSet, depth_views: int, threads: int, report: Report | None = None) -> Collected:
    """Count episodes, attempts and the annotations of all scenes of a data set, or of a split of it, in at most `threads` processes; errors
    as of `compute_statistics`. `depth_views`: number of views whose depth image is read, spread evenly over all views."""
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
    for counts, memory in _count(data_set, sampled, processes, lambda done: report and report("views", done, found.views)):
        found.counts.merge(counts)
        found.memory += memory
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
    """Tables of a scene, without images but those of `task.depth_frames`; of camera 0 also objects over time and light. Raises DatasetError
    if the data set has no images of it, or a file is missing or damaged."""
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


def _count(data_set: DataSet, tasks: Iterator[SceneTask], processes: int, report: Callable[[int], None]) -> Iterator[tuple[Counts, int]]:
    """Count scenes in several processes, or with one in the calling process; yields the counts and the peak memory [B] of each."""
    setup = partial(_Counter, data_set.folder if processes > 1 else data_set)
    with WorkerPool(WorkerProgram(setup, "process that counts"), processes if processes > 1 else 0) as pool:
        done = 0
        for views in pool.map_ordered((partial(_Counter.add, task=task) for task in tasks), depth=_DEPTH):
            done += views
            report(done)
        yield from map(pool.wait, pool.broadcast(_Counter.finish))


def _peak_memory() -> int:
    """Peak resident set size of this process [B]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIBIBYTE


class _Counter:
    """State of a worker process: a data set and the counts so far."""

    def __init__(self, data_set: DataSet | Path) -> None:
        self._data_set = DataSet(data_set) if isinstance(data_set, Path) else data_set
        self._counts = Counts()

    def add(self, task: SceneTask) -> int:
        """Task: count a scene; returns its number of views."""
        self._counts.add(read_scene(self._data_set, task))
        return task.frames

    def finish(self) -> tuple[Counts, int]:
        """Task: return the accumulated counts and the peak memory of the process."""
        return self._counts, _peak_memory()


OTHER_OBJECTS = "the objects are not those of the paper, so their distributions are not compared"
"""Note for data sets with objects other than the paper's."""
NOT_BAKED = "this data set is from another source: its scenes count as episodes, without modes, endings, attempts and times"
"""Note for data sets that other programs have written."""
DEPTH_VIEWS = 64
"""Views whose depth image is read."""
DEPTH_QUANTILES = (0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
LOOK_QUANTILES = (0.05, 0.5, 0.95)


def compute_statistics(
    data_set: DataSet, *, depth_views: int = DEPTH_VIEWS, threads: int = 0, report: Report | None = None
) -> figures.Statistics:
    """Compute the statistics of a data set, or of one of its splits, which is read once; memory does not grow with its size.

        statistics = compute_statistics(synpick_warp.open("DATA"))
        statistics.total.annotations.visibility

    Args:
        depth_views: Number of views whose depth image is read.
        threads: Maximum number of processes; 0: one per CPU core.
        report: Receives the progress: unit, done, total.

    Raises ConfigError: the settings are missing or damaged; DatasetError: there is no episode, or a file is missing or damaged;
    ProcessError: a process died."""
    return assemble(data_set, collect(data_set, depth_views, threads or count_cores(), report))


def assemble(data_set: DataSet, collected: Collected) -> figures.Statistics:
    """Compute the statistics of a data set from the counts."""
    counts, missing = collected.counts, list(collected.missing)
    order = {name: index for index, name in enumerate(data_set.splits)}
    groups = sorted(counts.groups(), key=lambda group: (order.get(group.split, len(order)), group.mode, group.split))
    rows = tuple(_group(counts, *group, groups=[group]) for group in groups)
    total = _group(counts, "", "", groups)
    objects = _objects(data_set, counts, total.annotations)
    kinds = {name: split_kind(folder) for name, folder in data_set.split_folders.items()}
    paper = compare(rows, kinds, {each.object_id: each.name for each in objects}, data_set.camera_count)
    depth, lights = depth_figures(counts), light_figures(counts)
    if not total.annotations.views:
        missing.append(
            "no images: no views, visibility, objects over time, coverage, depth or light maps; bake with --formats bop or shards"
        )
    else:
        missing += ["no depth images: no depth range"] if depth is None else []
        missing += ["scene_camera.json names no light maps"] if lights is None else []
    if data_set.found is not None:
        missing.append(NOT_BAKED)
    elif not total.episodes.attempts:
        missing.append("no attempts: no episode picks, so there are neither outcomes nor seal forces")
    if any(row.distance is None for row in paper):
        missing.append(OTHER_OBJECTS)
    drawn = look_figures(counts), bin_figures(counts), rest_figures(counts)
    return figures.Statistics(data_set.camera_count, rows, total, objects, depth, lights, paper, tuple(missing), *drawn)


def _group(counts: Counts, split: str, mode: str, groups: Collection[Group]) -> figures.GroupStatistics:
    """Aggregated statistics of several groups, labelled with a split and a mode."""
    parts = episode_figures(counts, groups), annotation_figures(counts, groups), timeline_figures(counts, groups)
    return figures.GroupStatistics(split, mode, *parts)


def _objects(data_set: DataSet, counts: Counts, total: figures.Annotations) -> tuple[figures.ObjectStatistics, ...]:
    """Statistics of each object that has a model or an annotation, by obj_id."""
    try:
        known = set(data_set.models_info)
    except DatasetError:
        known = set()
    object_ids = sorted(known | set(total.objects))
    names: dict[int, str] = {}
    if known:
        config = Config() if data_set.found else data_set.config
        names = object_names(data_set.folder, set(object_ids), config.object_rows, config.objects.diameter_tolerance)
    elif data_set.has_store:
        names = {each.object_id: each.name for each in data_set.objects}
    directions = counts.of("directions")
    return tuple(
        figures.ObjectStatistics(each, names.get(each, ""), total.objects.get(each, 0), coverage_figures(directions, each))
        for each in object_ids
    )


def episode_figures(counts: Counts, groups: Collection[Group]) -> figures.EpisodeFigures:
    """Episodes of some groups and their attempts."""
    totals, seals, loads = (counts.of(name, groups) for name in ("episodes", "seals", "loads"))
    return figures.EpisodeFigures(
        **{name: totals[name] for name in ("episodes", "frames", "objects", "picked", "lost", "attempts")},
        endings=_ranked(counts.of("endings", groups)),
        outcomes=_ranked(counts.of("outcomes", groups)),
        good_seals=counts.of("good_seals", groups)["good_seals"],
        seals=seals["seals"],
        force=seals["force"] / (columns.FORCE_UNIT * seals["seals"]) if seals["seals"] else None,
        force_histogram=_histogram(counts.of("forces", groups), columns.FORCE_BINS),
        largest_load=max(loads, default=None),
    )


def annotation_figures(counts: Counts, groups: Collection[Group]) -> figures.Annotations:
    """Annotations of some groups."""
    totals, objects = counts.of("views", groups), counts.of("objects", groups)
    return figures.Annotations(
        views=totals["views"],
        instances=objects.total(),
        visibility=totals["visibility"] / (columns.VISIBILITY_UNIT * totals["known"]) if totals["known"] else None,
        invisible=totals["invisible"],
        histogram=_histogram(counts.of("visibility", groups), columns.VISIBILITY_BINS),
        objects=dict(sorted(objects.items())),
    )


def timeline_figures(counts: Counts, groups: Collection[Group]) -> tuple[figures.TimePoint, ...]:
    """Mean number of objects over time in some groups."""
    sums = counts.of("timeline", groups)
    bins = sorted({index for index, _ in sums})
    return tuple(
        figures.TimePoint(each * columns.TIME_BIN, sums[each, "frames"], sums[each, "objects"] / sums[each, "frames"]) for each in bins
    )


def coverage_figures(directions: Mapping[tuple[int, int], int], object_id: int) -> figures.Coverage:
    """Pose coverage of an object, from the numbers of views by obj_id and bin. Symmetries are not taken into account: of a can, all
    longitudes look the same, and count as different."""
    bins = tuple(directions.get((object_id, index), 0) for index in range(columns.DIRECTION_BINS))
    total = sum(bins)
    shares = [count / total for count in bins if count]
    evenness = max(0.0, -math.fsum(share * math.log(share) for share in shares)) / math.log(columns.DIRECTION_BINS)
    return figures.Coverage(total, len(shares) / columns.DIRECTION_BINS, evenness, bins)


def depth_figures(counts: Counts) -> figures.Depth | None:
    """Depth of the pixels of all depth images that were read; None: none was."""
    totals = counts.of("depth_views")
    if not totals["pixels"]:
        return None
    pixels = {each: number for (each, _), number in counts.of("depths").items()}
    # Ranks count from 1 on, so that both ends are pixels.
    quantiles = {share: (each + 0.5) * columns.DEPTH_BIN for share, each in _quantiles(pixels, DEPTH_QUANTILES).items()}
    return figures.Depth(totals["views"], totals["pixels"], totals["missing"] / totals["pixels"], quantiles)


def light_figures(counts: Counts) -> figures.LightFigures | None:
    """Light of all episodes; None: no episode names its light."""
    maps = counts.of("light_maps")
    if not maps:
        return None
    exposure = {round(index * columns.EXPOSURE_BIN, 6): count for index, count in sorted(counts.of("exposures").items())}
    return figures.LightFigures(maps.total(), _ranked(maps), _histogram(counts.of("light_yaws"), columns.YAW_BINS), exposure)


def look_figures(counts: Counts) -> tuple[figures.LookStatistics, ...]:
    """Randomized appearance parameters by part, sorted; empty: appearance is not randomized."""
    drawn: dict[tuple[str, str], dict[float, int]] = {}
    for (part, parameter, value), count in counts.of("looks").items():
        drawn.setdefault((part, parameter), {})[value] = count
    return tuple(
        figures.LookStatistics(*key, sum(values.values()), tuple(_quantiles(values, LOOK_QUANTILES).values()))
        for key, values in sorted(drawn.items())
    )


def bin_figures(counts: Counts) -> dict[str, figures.BinUse]:
    """Use of each bin, the most frequent first."""
    steps: dict[tuple[str, str], list[int]] = {}
    for name, axis, step in counts.of("bin_places"):
        steps.setdefault((name, axis), []).append(step)
    ends: dict[tuple[str, str], figures.Range] = {
        (name, axis): (min(found) * columns.BIN_STEPS[axis], (max(found) + 1) * columns.BIN_STEPS[axis])
        for (name, axis), found in steps.items()
    }
    return {
        name: figures.BinUse(count, *(ends[name, axis] for axis in columns.BIN_STEPS)) for name, count in _ranked(counts.of("bins")).items()
    }


def rest_figures(counts: Counts) -> figures.Rest | None:
    """Windows of piles at rest; None: there is none."""
    windows = counts.of("windows")
    return figures.Rest(windows["at_rest"], windows["vibrating"]) if windows["at_rest"] else None


def _ranked(counts: Mapping[str, int]) -> dict[str, int]:
    """Counts by name, the largest first."""
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _histogram(counts: Mapping[int, int], size: int) -> tuple[int, ...]:
    return tuple(counts.get(index, 0) for index in range(size))


def _quantiles(counts: Mapping[float, int], shares: Sequence[float]) -> dict[float, float]:
    """Value at each quantile of numbers that are given by counts (the inverse of their distribution function); empty: there are none."""
    values = sorted(counts)
    bounds = np.cumsum([counts[value] for value in values])
    return {share: values[int(np.searchsorted(bounds, share * bounds[-1]))] for share in shares if values}


_NAME = re.compile(r"[0-9]{3}_(.+)")
"""Name of an object in the YCB set; the paper's plot leaves the number out."""
_Count = Annotated[int, msgspec.Meta(ge=1)]


class PaperGroup(msgspec.Struct, frozen=True):
    """Statistics that the paper publishes for one split and mode."""

    split: str
    mode: str
    sequences: _Count
    views: _Count
    visibility: float
    """Mean visible fraction."""
    objects: dict[str, int]
    """Annotated instances by name of the object."""

    @property
    def instances(self) -> int:
        """Annotated instances of all objects."""
        return sum(self.objects.values())


class Paper(msgspec.Struct, frozen=True):
    """Statistics of the SynPick data set, as published."""

    cameras: int
    total_views: int
    total_visibility: float
    groups: list[PaperGroup]

    def group(self, split: str, mode: str) -> PaperGroup | None:
        """Row of a split and mode in the paper's table; None: it has none."""
        return next((each for each in self.groups if (each.split, each.mode) == (split, mode)), None)


@functools.cache
def read_paper() -> Paper:
    """Read the paper's numbers from paper.toml."""
    return msgspec.convert(read_toml(Path(__file__).with_name("paper.toml"), DatasetError), Paper)


def compare(groups: Sequence[GroupStatistics], kinds: Mapping[str, str], names: Mapping[int, str], cameras: int) -> tuple[Comparison, ...]:
    """Compare the groups that the paper also reports with its numbers. `kinds`: split -> train, val or test; `names`: by obj_id."""
    paper, rows = read_paper(), []
    for group in groups:
        ours, sequences = group.annotations, group.episodes.episodes
        theirs = paper.group(kinds.get(group.split, group.split), group.mode)
        if theirs is None or not ours.views:
            continue
        other = paper.group("test" if theirs.split == "train" else "train", theirs.mode)
        distance = total_variation(theirs.objects, other.objects) if other else 0.0
        mine = Numbers(sequences, ours.views, ours.views / (sequences * cameras), ours.visibility, ours.instances_per_view)
        pair = mine, _numbers(theirs, paper.cameras)
        rows.append(Comparison(group.split, group.mode, *pair, object_distance(ours.objects, names, theirs.objects), distance))
    return tuple(rows)


def _numbers(group: PaperGroup, cameras: int) -> Numbers:
    """Published figures of a split and mode in the layout of our statistics; frames are counted per sequence."""
    frames = group.views / (group.sequences * cameras)
    return Numbers(group.sequences, group.views, frames, group.visibility, group.instances / group.views)


def object_distance(ours: Mapping[int, int], names: Mapping[int, str], theirs: Mapping[str, int]) -> float | None:
    """Total variation distance of instances by obj_id to instances by the paper's names; None: an object has none of these names."""
    counts: dict[str, int] = {}
    for object_id, count in ours.items():
        match = _NAME.fullmatch(names.get(object_id, ""))
        name = match[1] if match else ""
        if name not in theirs:
            return None
        counts[name] = counts.get(name, 0) + count
    return total_variation(counts, theirs) if counts else None


def total_variation(first: Mapping[str, int], second: Mapping[str, int]) -> float:
    """Total variation distance ½ Σ |p - q| of two distributions, given as counts."""
    totals = sum(first.values()), sum(second.values())
    return 0.5 * sum(abs(first.get(key, 0) / totals[0] - second.get(key, 0) / totals[1]) for key in {**first, **second})
