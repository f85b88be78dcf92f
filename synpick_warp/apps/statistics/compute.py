"""Statistics of a data set: computes the figures of all groups from the counts."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from synpick_warp.apps.statistics import columns, figures
from synpick_warp.apps.statistics.collect import Collected, Report, collect
from synpick_warp.apps.statistics.counts import Counts, Group
from synpick_warp.apps.statistics.paper import compare
from synpick_warp.configs.dataset.splits import split_kind
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.bop.models import object_names
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from synpick_warp.system.hardware.cores import count_cores

OTHER_OBJECTS = "the objects are not those of the paper, so their distributions are not compared"
"""What is missing of data sets of other objects."""
NOT_BAKED = "this data set is from another source: its scenes count as episodes, without modes, endings, attempts and times"
"""What is missing of data sets of other programs."""
DEPTH_VIEWS = 64
"""Views whose depth image is read."""
DEPTH_QUANTILES = (0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
LOOK_QUANTILES = (0.05, 0.5, 0.95)


def compute_statistics(
    data_set: DataSet, *, depth_views: int = DEPTH_VIEWS, threads: int = 0, report: Report | None = None
) -> figures.Statistics:
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
    """Statistics of some groups together, under the name of a split and a mode."""
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
    """What was drawn of each part and parameter, sorted; none: looks are not randomized."""
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
    """Counts of bins 0 to `size` - 1."""
    return tuple(counts.get(index, 0) for index in range(size))


def _quantiles(counts: Mapping[float, int], shares: Sequence[float]) -> dict[float, float]:
    """Value at each quantile of numbers that are given by counts (the inverse of their distribution function); empty: there are none."""
    values = sorted(counts)
    bounds = np.cumsum([counts[value] for value in values])
    return {share: values[int(np.searchsorted(bounds, share * bounds[-1]))] for share in shares if values}
