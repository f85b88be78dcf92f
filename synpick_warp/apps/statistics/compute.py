"""Statistics of a data set: assembles the figures of all groups."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from synpick_warp.apps.statistics.annotations import Annotations
from synpick_warp.apps.statistics.attempts import Episodes
from synpick_warp.apps.statistics.bins import BinUse
from synpick_warp.apps.statistics.collect import Collected, Report, collect
from synpick_warp.apps.statistics.counting import Group
from synpick_warp.apps.statistics.coverage import Coverage
from synpick_warp.apps.statistics.depth import Depth
from synpick_warp.apps.statistics.lights import Lights
from synpick_warp.apps.statistics.looks import LookStatistics
from synpick_warp.apps.statistics.paper import Comparison, compare
from synpick_warp.apps.statistics.rest import Rest
from synpick_warp.apps.statistics.timeline import TimePoint
from synpick_warp.configs.dataset.splits import split_kind
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.object_names import object_names
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from synpick_warp.system.hardware.cores import count_cores

OTHER_OBJECTS = "the objects are not those of the paper, so their distributions are not compared"
"""What is missing of data sets of other objects."""
NOT_BAKED = "this data set is from another source: its scenes count as episodes, without modes, endings, attempts and times"
"""What is missing of data sets of other programs."""
DEPTH_VIEWS = 64
"""Views whose depth image is read."""


@dataclass(frozen=True)
class GroupStatistics:
    """Statistics of the episodes of a split and a mode (empty: all): episodes, annotations, objects over time."""

    split: str
    """Name of the split; empty: all."""
    mode: str
    """pick, target or move; empty: all."""
    episodes: Episodes
    annotations: Annotations
    objects_over_time: tuple[TimePoint, ...]


@dataclass(frozen=True)
class ObjectStatistics:
    """Statistics of one object: obj_id, name, annotated instances, coverage of viewing directions."""

    object_id: int
    name: str
    """Empty: it is not known."""
    instances: int
    """Annotated instances."""
    coverage: Coverage


@dataclass(frozen=True)
class Statistics:
    """Statistics of a data set: groups and total, objects, depth, lights (None: not read), comparison with the paper, what is
    missing, looks and bins.
    """

    cameras: int
    groups: tuple[GroupStatistics, ...]
    """By split in the order of the settings, then by mode."""
    total: GroupStatistics
    objects: tuple[ObjectStatistics, ...]
    """By obj_id: the objects that are annotated, and those of the models folder that never are."""
    depth: Depth | None
    """None: no depth image was read."""
    lights: Lights | None
    """None: no scene names its light."""
    paper: tuple[Comparison, ...]
    """Groups that the paper has, too."""
    missing: tuple[str, ...]
    """What the data set does not have, a sentence each."""
    looks: tuple[LookStatistics, ...] = ()
    """By part and parameter; none: looks are not randomized."""
    bins: Mapping[str, BinUse] = field(default_factory=dict)
    """By name; empty: no episode names its bin, since the tote is always in its place."""
    rest: Rest | None = None
    """None: no steps of piles at rest were recorded."""

    @property
    def has_paper_objects(self) -> bool:
        """Whether the objects are those of the paper, with which a comparison makes sense."""
        return any(row.distance is not None for row in self.paper)


def compute_statistics(data_set: DataSet, *, depth_views: int = DEPTH_VIEWS, threads: int = 0, report: Report | None = None) -> Statistics:
    """Compute the statistics of a data set, which is read once; memory does not grow with its size.

        statistics = compute_statistics(synpick_warp.open("DATA"))
        statistics.total.annotations.visibility

    Args:
        data_set: The data set, or one of its splits.
        depth_views: Number of views whose depth image is read.
        threads: Maximum number of processes; 0: one per CPU core.
        report: Receives the progress: unit, done, total.

    Raises:
        ConfigError: The settings are missing or damaged.
        DatasetError: There is no episode, or a file is missing or damaged.
        ProcessError: A process died.
    """
    return assemble(data_set, collect(data_set, depth_views, threads or count_cores(), report))


def assemble(data_set: DataSet, collected: Collected) -> Statistics:
    """Compute the statistics of a data set from the counts."""
    partial, missing = collected.partial, list(collected.missing)
    order = {name: index for index, name in enumerate(data_set.splits)}
    groups = sorted(partial.episodes.groups(), key=lambda group: (order.get(group.split, len(order)), group.mode))

    def figures(split: str, mode: str, members: Iterable[Group]) -> GroupStatistics:
        members = tuple(members)
        counted = partial.episodes.result(members), partial.annotations.result(members), partial.timeline.result(members)
        return GroupStatistics(split, mode, *counted)

    rows = tuple(figures(*group, [group]) for group in groups)
    total = figures("", "", groups)
    objects = _objects(data_set, collected, total.annotations)
    kinds = {name: split_kind(folder) for name, folder in data_set.split_folders.items()}
    paper = compare(
        {group: row.annotations for group, row in zip(groups, rows, strict=True)},
        {group: row.episodes.episodes for group, row in zip(groups, rows, strict=True)},
        kinds,
        {each.object_id: each.name for each in objects},
        data_set.camera_count,
    )
    depth, lights = partial.depth.result(), partial.lights.result()
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
    drawn = partial.looks.result(), partial.bins.result(), partial.rest.result()
    return Statistics(data_set.camera_count, rows, total, objects, depth, lights, paper, tuple(missing), *drawn)


def _objects(data_set: DataSet, collected: Collected, total: Annotations) -> tuple[ObjectStatistics, ...]:
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
    return tuple(
        ObjectStatistics(each, names.get(each, ""), total.objects.get(each, 0), collected.partial.coverage.result(each))
        for each in object_ids
    )
