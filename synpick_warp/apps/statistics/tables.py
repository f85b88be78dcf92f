"""Tables of statistics: title, columns and values, one list for text, CSV and pages alike."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

from synpick_warp.apps.statistics.annotations import VISIBILITY_BINS
from synpick_warp.apps.statistics.attempts import FORCE_BIN, FORCE_BINS
from synpick_warp.apps.statistics.compute import GroupStatistics, Statistics
from synpick_warp.apps.statistics.coverage import BANDS, SECTORS
from synpick_warp.apps.statistics.lights import YAW_BINS
from synpick_warp.apps.statistics.looks import QUANTILES
from synpick_warp.apps.statistics.paper import read_paper
from synpick_warp.system.codecs.tables import Column, Table, Value

ALL = "all"
"""Label of the row over all splits or modes."""
PAPER = "paper"
"""Name of the table beside the paper's numbers."""
TIMELINE = "objects_over_time"
"""Name of the table of objects over time."""
TURN = 360.0
"""A full turn [°]."""


GROUP_COLUMNS = (Column("split"), Column("mode"))


def make_tables(statistics: Statistics) -> list[Table]:
    """Make all tables of the statistics that have rows."""
    makers: tuple[Callable[[Statistics], Table], ...] = (
        _groups,
        _paper,
        _objects,
        _annotations,
        _visibility,
        _endings,
        _outcomes,
        _seals,
        _forces,
        _timeline,
        _depth,
        _lights,
        _yaw,
        _exposure,
        _looks,
        _bins,
        _coverage,
    )
    return [table for table in (make(statistics) for make in makers) if table.rows]


def _label(row: GroupStatistics) -> tuple[str, str]:
    """First cells of a group's row: split and mode; `ALL` where the row sums over them."""
    return row.split or ALL, row.mode or ALL


def _rows(statistics: Statistics) -> tuple[GroupStatistics, ...]:
    """Groups, and the total if it differs from the only group."""
    return (*statistics.groups, statistics.total) if len(statistics.groups) > 1 else statistics.groups


def _groups(statistics: Statistics) -> Table:
    """Table of views, instances and mean visibility, by split and mode."""
    columns = (
        *GROUP_COLUMNS,
        Column("episodes", ","),
        Column("views", ","),
        Column("instances", ","),
        Column("instances_per_view", ".2f"),
        Column("mean_visibility", ".3f"),
        Column("invisible", ".1%"),
    )
    table = Table("groups", "Views and mean visibility, by split and mode", columns)
    for row in _rows(statistics):
        counts = row.annotations
        hidden = counts.invisible / counts.instances if counts.instances else None
        values = (row.episodes.episodes, counts.views, counts.instances, counts.instances_per_view, counts.visibility, hidden)
        table.rows.append((*_label(row), *values))
    return table


def _paper(statistics: Statistics) -> Table:
    """Table of the paper's numbers beside those of the data set, by split and mode."""
    paper = read_paper()
    columns = (
        *GROUP_COLUMNS,
        Column("sequences", ","),
        Column("sequences_paper", ",", "paper"),
        Column("views", ","),
        Column("views_paper", ",", "paper"),
        Column("frames", ".0f"),
        Column("frames_paper", ".0f", "paper"),
        Column("frames_difference", "+.0%", "diff"),
        Column("visibility", ".2f", "visible"),
        Column("visibility_paper", ".2f", "paper"),
        Column("visibility_difference", "+.2f", "diff"),
        Column("instances_per_view", ".1f", "inst."),
        Column("instances_per_view_paper", ".1f", "paper"),
        Column("object_distance", ".3f", "TV"),
        Column("object_distance_in_paper", ".3f", "paper"),
    )
    title = (
        f"Beside SynPick (CASE 2021; in all {paper.total_views:,} views, mean visibility {paper.total_visibility}): frames of a sequence,\n"
        "instances a view, total variation (TV) distance of the instances over objects to the paper's, and of its train to its test"
    )
    table = Table(PAPER, title, columns)
    for row in statistics.paper:
        ours, theirs = row.ours, row.paper
        seen = None if ours.visibility is None or theirs.visibility is None else ours.visibility - theirs.visibility
        pairs = (ours.sequences, theirs.sequences, ours.views, theirs.views, ours.views_per_sequence, theirs.views_per_sequence)
        frames = ours.views_per_sequence / theirs.views_per_sequence - 1.0
        rest = (ours.visibility, theirs.visibility, seen, ours.instances_per_view, theirs.instances_per_view)
        table.rows.append((row.split, row.mode, *pairs, frames, *rest, row.distance, row.paper_distance))
    return table


def _objects(statistics: Statistics) -> Table:
    """Table of annotated instances by object and mode, with the coverage of viewing directions."""
    modes = list(dict.fromkeys(row.mode for row in statistics.groups))
    columns = (
        Column("object_id"),
        Column("name"),
        *(Column(mode, ",") for mode in modes),
        Column(ALL, ","),
        Column("share", ".1%"),
        Column("directions_seen", ".0%"),
        Column("evenness", ".2f"),
    )
    title = "Annotated instances by object and mode; viewing directions: seen bins of the sphere, and how even they are"
    table = Table("objects", title, columns)
    total = statistics.total.annotations.instances
    for each in statistics.objects if total else ():
        counts = [sum(row.annotations.objects.get(each.object_id, 0) for row in statistics.groups if row.mode == mode) for mode in modes]
        rest = (each.instances, each.instances / total, each.coverage.occupied, each.coverage.evenness)
        table.rows.append((each.object_id, each.name, *counts, *rest))
    return table


def _annotations(statistics: Statistics) -> Table:
    """Table of annotated instances by split, mode and object; left out of the printed text."""
    columns = (*GROUP_COLUMNS, Column("object_id"), Column("name"), Column("instances", ","))
    rows: list[tuple[Value, ...]] = [
        (*_label(row), each.object_id, each.name, row.annotations.objects.get(each.object_id, 0))
        for row in statistics.groups
        if row.annotations.views
        for each in statistics.objects
    ]
    return Table("annotations", "Annotated instances by split, mode and object", columns, rows, in_text=False)


def _visibility(statistics: Statistics) -> Table:
    """Histogram of the visible fraction of instances, a column for each group."""
    columns = (Column("from", ".2f"), Column("to", ".2f"), *_group_columns(statistics))
    table = Table("visibility", "Instances by visible fraction", columns)
    for index in range(VISIBILITY_BINS) if statistics.total.annotations.instances else ():
        counts = [row.annotations.histogram[index] for row in _rows(statistics)]
        table.rows.append((index / VISIBILITY_BINS, (index + 1) / VISIBILITY_BINS, *counts))
    return table


def _group_columns(statistics: Statistics, style: str = ",") -> Iterable[Column]:
    """One column for each group (split and mode, and all), in the number format `style`."""
    return (Column(" ".join(dict.fromkeys(_label(row))), style) for row in _rows(statistics))


def _endings(statistics: Statistics) -> Table:
    """Table of episodes by ending, by split and mode."""
    columns = (*GROUP_COLUMNS, Column("ending"), Column("episodes", ","), Column("fraction", ".1%"))
    return Table("endings", "Endings of episodes", columns, _by_name(statistics, lambda row: row.episodes.endings))


def _outcomes(statistics: Statistics) -> Table:
    """Table of attempts by outcome, by split and mode."""
    columns = (*GROUP_COLUMNS, Column("outcome"), Column("attempts", ","), Column("fraction", ".1%"))
    return Table("outcomes", "Outcomes of attempts to pick", columns, _by_name(statistics, lambda row: row.episodes.outcomes))


def _by_name(statistics: Statistics, counts: Callable[[GroupStatistics], dict[str, int]]) -> list[tuple[Value, ...]]:
    """Rows (split, mode, name, count, fraction of the group)."""
    rows: list[tuple[Value, ...]] = []
    for row in statistics.groups:
        found = counts(row)
        rows += [(*_label(row), name, count, count / sum(found.values())) for name, count in found.items()]
    return rows


def _seals(statistics: Statistics) -> Table:
    """Table of objects, attempts and seals, by split and mode."""
    columns = (
        *GROUP_COLUMNS,
        Column("objects", ","),
        Column("picked", ","),
        Column("lost", ","),
        Column("attempts", ","),
        Column("attempts_per_episode", ".2f"),
        Column("engaged", ","),
        Column("good_seals", ","),
        Column("mean_peak_force_N", ".1f"),
    )
    table = Table("attempts", "Objects and attempts; mean over engaged attempts of the largest seal force [N]", columns)
    for row in _rows(statistics) if statistics.total.episodes.attempts else ():
        each = row.episodes
        rate = each.attempts / each.episodes if each.episodes else None
        values = (each.objects, each.picked, each.lost, each.attempts, rate, each.seals, each.good_seals, each.force)
        table.rows.append((*_label(row), *values))
    return table


def _forces(statistics: Statistics) -> Table:
    """Histogram of the largest seal force of attempts [N], a column for each group; the last bin has no upper end (None)."""
    columns = (Column("from_N", ".0f"), Column("to_N", ".0f"), *_group_columns(statistics))
    table = Table("seal_forces", "Attempts by largest seal force [N]", columns)
    last = max((index for index, count in enumerate(statistics.total.episodes.force_histogram) if count), default=-1)
    for index in range(last + 1):
        end = None if index == FORCE_BINS - 1 else (index + 1) * FORCE_BIN
        counts = [row.episodes.force_histogram[index] for row in _rows(statistics)]
        table.rows.append((index * FORCE_BIN, end, *counts))
    return table


def _timeline(statistics: Statistics) -> Table:
    """Table of the mean number of objects in the scene by time [s], a column for each group; None: no frame at that time."""
    columns = (Column("time_s", ".0f"), *_group_columns(statistics, ".2f"))
    table = Table(TIMELINE, "Mean number of objects in the scene, by time since the first frame [s]", columns)
    groups = [{point.time: point.objects for point in row.objects_over_time} for row in _rows(statistics)]
    for time in sorted({time for group in groups for time in group}):
        table.rows.append((time, *(group.get(time) for group in groups)))
    return table


def _depth(statistics: Statistics) -> Table:
    """Table of depth quantiles [mm] over the sampled views; empty without depth."""
    depth = statistics.depth
    views = f"{depth.views:,} sampled views, {depth.missing:.2%} of the pixels without measurement" if depth else ""
    rows: list[tuple[Value, ...]] = list(depth.quantiles.items()) if depth else []
    return Table("depth", f"Planar depth of pixels [mm] ({views})", (Column("quantile", ".0%"), Column("depth_mm", ".1f")), rows)


def _lights(statistics: Statistics) -> Table:
    """Table of episodes by environment map; empty if lights are not known."""
    lights = statistics.lights
    rows: list[tuple[Value, ...]] = [(name, count, count / lights.episodes) for name, count in lights.maps.items()] if lights else []
    return Table("lights", "Environment maps", (Column("map"), Column("episodes", ","), Column("fraction", ".1%")), rows)


def _yaw(statistics: Statistics) -> Table:
    """Histogram of the environment map's yaw [°] over episodes; left out of the printed text."""
    step = TURN / YAW_BINS
    counts: Sequence[int] = statistics.lights.yaw if statistics.lights else ()
    rows: list[tuple[Value, ...]] = [(index * step, (index + 1) * step, count) for index, count in enumerate(counts)]
    columns = (Column("from_degrees", ".0f"), Column("to_degrees", ".0f"), Column("episodes", ","))
    return Table("light_yaw", "Episodes by yaw of the environment map [°]", columns, rows, in_text=False)


def _exposure(statistics: Statistics) -> Table:
    """Histogram of exposure compensation [EV] over episodes; left out of the printed text."""
    rows: list[tuple[Value, ...]] = list(statistics.lights.exposure.items()) if statistics.lights else []
    columns = (Column("from_EV", ".1f"), Column("episodes", ","))
    return Table("light_exposure", "Episodes by exposure compensation [EV]", columns, rows, in_text=False)


def _looks(statistics: Statistics) -> Table:
    """Table of what episodes have drawn, by part and parameter; empty if looks are not randomized."""
    columns = (
        Column("part"),
        Column("parameter"),
        Column("draws", ","),
        *(Column(f"quantile_{share}", ".3g", f"{share:.0%}") for share in QUANTILES),
    )
    rows: list[tuple[Value, ...]] = [(row.part, row.parameter, row.draws, *row.quantiles) for row in statistics.looks]
    return Table("looks", "Randomized looks: quantiles of what episodes have drawn", columns, rows)


def _bins(statistics: Statistics) -> Table:
    """Table of episodes by bin, with the intervals that its places span; empty if bins are not told."""
    total = sum(use.episodes for use in statistics.bins.values())
    rows: list[tuple[Value, ...]] = [
        (name, use.episodes, use.episodes / total, *(1e3 * end for end in (*use.x, *use.y)), *map(math.degrees, use.yaw))
        for name, use in statistics.bins.items()
    ]
    ends = [
        Column(f"{axis}_{end}_{unit}", ".0f") for axis, unit in (("x", "mm"), ("y", "mm"), ("yaw", "degrees")) for end in ("from", "to")
    ]
    return Table("bins", "Bins and where they stand", (Column("bin"), Column("episodes", ","), Column("fraction", ".1%"), *ends), rows)


def _coverage(statistics: Statistics) -> Table:
    """Table of views by object and bin of the viewing direction in its frame, without empty bins; left out of the printed text."""
    columns = (Column("object_id"), Column("z_from"), Column("z_to"), Column("longitude_from"), Column("longitude_to"), Column("views"))
    table = Table("coverage", "Views by object and viewing direction in its frame", columns, in_text=False)
    heights = [2.0 * index / BANDS - 1.0 for index in range(BANDS + 1)]
    turns = [TURN * index / SECTORS - TURN / 2.0 for index in range(SECTORS + 1)]
    cells = [(*z, *turn) for z in pairwise(heights) for turn in pairwise(turns)]
    for each in statistics.objects:
        seen = zip(cells, each.coverage.bins, strict=True)
        table.rows.extend((each.object_id, *(round(edge, 6) for edge in cell), count) for cell, count in seen if count)
    return table
