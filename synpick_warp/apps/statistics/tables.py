"""Tables of statistics: title, columns and values, one list for text, CSV and pages alike; statistics as text, JSON and CSV."""

import dataclasses
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path

from rich.console import Console
from rich.text import Text

from synpick_warp.apps.statistics.columns import (
    BANDS,
    FORCE_BIN,
    FORCE_BINS,
    REST_AMPLITUDE,
    REST_WINDOW,
    SECTORS,
    VISIBILITY_BINS,
    YAW_BINS,
)
from synpick_warp.apps.statistics.compute import LOOK_QUANTILES, OTHER_OBJECTS, read_paper
from synpick_warp.apps.statistics.figures import GroupStatistics, Statistics
from synpick_warp.errors import OutputError, escape
from synpick_warp.exporters.writing.files import output_error
from synpick_warp.system.codecs.tables import Column, Table, Value, parse_columns, to_csv, to_text
from synpick_warp.system.inputs.files import make_folder

ALL = "all"
"""Label of the row over all splits or modes."""
PAPER = "paper"
"""Name of the table beside the paper's numbers."""
TIMELINE = "objects_over_time"
"""Name of the table of objects over time."""
TURN = 360.0
"""A full turn [°]."""
Columns = tuple[Column, ...]
Rows = Iterator[tuple[Value, ...]]

_MAKERS: list[Callable[[Statistics], Table]] = []
"""Functions that make the tables, in their order."""


def make_tables(statistics: Statistics) -> list[Table]:
    """Make all tables of the statistics that have rows."""
    return [table for make in _MAKERS if (table := make(statistics)).rows]


def _table(
    name: str,
    title: str | Callable[[Statistics], str],
    columns: str | Callable[[Statistics], Columns],
    in_text: bool = True,
) -> Callable[[Callable[[Statistics], Rows]], Callable[[Statistics], Rows]]:
    """Decorator that registers a table by the function that yields its rows; columns as of `parse_columns`."""

    def register(rows: Callable[[Statistics], Rows]) -> Callable[[Statistics], Rows]:
        def make(statistics: Statistics) -> Table:
            shown = title if isinstance(title, str) else title(statistics)
            named = parse_columns(columns) if isinstance(columns, str) else columns(statistics)
            return Table(name, shown, named, list(rows(statistics)), in_text)

        _MAKERS.append(make)
        return rows

    return register


def _label(row: GroupStatistics) -> tuple[str, str]:
    """First cells of a group's row: split and mode; `ALL` where the row sums over them."""
    return row.split or ALL, row.mode or ALL


def _with_total(statistics: Statistics) -> tuple[GroupStatistics, ...]:
    """Groups, and the total if it differs from the only group."""
    return (*statistics.groups, statistics.total) if len(statistics.groups) > 1 else statistics.groups


def _by_group(names: str, style: str = ",") -> Callable[[Statistics], Columns]:
    """Columns `names`, and one for each group (split and mode, and all) in the format `style`."""
    return lambda statistics: (
        *parse_columns(names),
        *(Column(" ".join(dict.fromkeys(_label(row))), style) for row in _with_total(statistics)),
    )


@_table(
    "groups",
    "Views and mean visibility, by split and mode",
    "split mode episodes:, views:, instances:, instances_per_view:.2f mean_visibility:.3f invisible:.1%",
)
def _groups(statistics: Statistics) -> Rows:
    for row in _with_total(statistics):
        each = row.annotations
        hidden = each.invisible / each.instances if each.instances else None
        yield *_label(row), row.episodes.episodes, each.views, each.instances, each.instances_per_view, each.visibility, hidden


@_table(
    PAPER,
    lambda _: (
        f"Beside SynPick (CASE 2021; in all {read_paper().total_views:,} views, mean visibility {read_paper().total_visibility}): "
        "frames of a sequence,\n"
        "instances a view, total variation (TV) distance of the instances over objects to the paper's, and of its train to its test"
    ),
    "split mode sequences:, sequences_paper:,:paper views:, views_paper:,:paper frames:.0f frames_paper:.0f:paper"
    " frames_difference:+.0%:diff visibility:.2f:visible visibility_paper:.2f:paper visibility_difference:+.2f:diff"
    " instances_per_view:.1f:inst. instances_per_view_paper:.1f:paper object_distance:.3f:TV object_distance_in_paper:.3f:paper",
)
def _paper(statistics: Statistics) -> Rows:
    for row in statistics.paper:
        ours, theirs = row.ours, row.paper
        seen = None if ours.visibility is None or theirs.visibility is None else ours.visibility - theirs.visibility
        pairs = (ours.sequences, theirs.sequences, ours.views, theirs.views, ours.views_per_sequence, theirs.views_per_sequence)
        frames = ours.views_per_sequence / theirs.views_per_sequence - 1.0
        rest = (ours.visibility, theirs.visibility, seen, ours.instances_per_view, theirs.instances_per_view)
        yield row.split, row.mode, *pairs, frames, *rest, row.distance, row.paper_distance


def _object_columns(statistics: Statistics) -> Columns:
    modes = (Column(mode, ",") for mode in (*dict.fromkeys(row.mode for row in statistics.groups), ALL))
    return (*parse_columns("object_id name"), *modes, *parse_columns("share:.1% directions_seen:.0% evenness:.2f"))


@_table(
    "objects",
    "Annotated instances by object and mode; viewing directions: seen bins of the sphere, and how even they are",
    _object_columns,
)
def _objects(statistics: Statistics) -> Rows:
    total = statistics.total.annotations.instances
    for each in statistics.objects if total else ():
        counts = dict.fromkeys((row.mode for row in statistics.groups), 0)
        for row in statistics.groups:
            counts[row.mode] += row.annotations.objects.get(each.object_id, 0)
        shares = (each.instances / total, each.coverage.occupied, each.coverage.evenness)
        yield each.object_id, each.name, *counts.values(), each.instances, *shares


@_table("annotations", "Annotated instances by split, mode and object", "split mode object_id name instances:,", in_text=False)
def _annotations(statistics: Statistics) -> Rows:
    for row in statistics.groups:
        for each in statistics.objects if row.annotations.views else ():
            yield *_label(row), each.object_id, each.name, row.annotations.objects.get(each.object_id, 0)


@_table("visibility", "Instances by visible fraction", _by_group("from:.2f to:.2f"))
def _visibility(statistics: Statistics) -> Rows:
    for index in range(VISIBILITY_BINS) if statistics.total.annotations.instances else ():
        counts = [row.annotations.histogram[index] for row in _with_total(statistics)]
        yield index / VISIBILITY_BINS, (index + 1) / VISIBILITY_BINS, *counts


@_table("endings", "Endings of episodes", "split mode ending episodes:, fraction:.1%")
def _endings(statistics: Statistics) -> Rows:
    yield from _shares(statistics, lambda row: row.episodes.endings)


@_table("outcomes", "Outcomes of attempts to pick", "split mode outcome attempts:, fraction:.1%")
def _outcomes(statistics: Statistics) -> Rows:
    yield from _shares(statistics, lambda row: row.episodes.outcomes)


def _shares(statistics: Statistics, counts: Callable[[GroupStatistics], Mapping[str, int]]) -> Rows:
    """Rows of split, mode, name, count, and fraction of the group."""
    for row in statistics.groups:
        found = counts(row)
        yield from ((*_label(row), name, count, count / sum(found.values())) for name, count in found.items())


@_table(
    "attempts",
    "Objects and attempts; mean over engaged attempts of the largest seal force [N]",
    "split mode objects:, picked:, lost:, attempts:, attempts_per_episode:.2f engaged:, good_seals:, mean_peak_force_N:.1f",
)
def _attempts(statistics: Statistics) -> Rows:
    for row in _with_total(statistics) if statistics.total.episodes.attempts else ():
        each = row.episodes
        rate = each.attempts / each.episodes if each.episodes else None
        yield *_label(row), each.objects, each.picked, each.lost, each.attempts, rate, each.seals, each.good_seals, each.force


@_table("seal_forces", "Attempts by largest seal force [N]", _by_group("from_N:.0f to_N:.0f"))
def _forces(statistics: Statistics) -> Rows:
    """The last bin has no upper end (None)."""
    last = max((index for index, count in enumerate(statistics.total.episodes.force_histogram) if count), default=-1)
    for index in range(last + 1):
        end = None if index == FORCE_BINS - 1 else (index + 1) * FORCE_BIN
        yield index * FORCE_BIN, end, *(row.episodes.force_histogram[index] for row in _with_total(statistics))


@_table(TIMELINE, "Mean number of objects in the scene, by time since the first frame [s]", _by_group("time_s:.0f", ".2f"))
def _timeline(statistics: Statistics) -> Rows:
    """None: no frame at that time."""
    groups = [{point.time: point.objects for point in row.objects_over_time} for row in _with_total(statistics)]
    for time in sorted({time for group in groups for time in group}):
        yield time, *(group.get(time) for group in groups)


def _depth_title(statistics: Statistics) -> str:
    depth = statistics.depth
    views = f"{depth.views:,} sampled views, {depth.missing:.2%} of the pixels without measurement" if depth else ""
    return f"Planar depth of pixels [mm] ({views})"


@_table("depth", _depth_title, "quantile:.0% depth_mm:.1f")
def _depth(statistics: Statistics) -> Rows:
    yield from statistics.depth.quantiles.items() if statistics.depth else ()


@_table("lights", "Environment maps", "map episodes:, fraction:.1%")
def _light_maps(statistics: Statistics) -> Rows:
    if lights := statistics.lights:
        yield from ((name, count, count / lights.episodes) for name, count in lights.maps.items())


@_table("light_yaw", "Episodes by yaw of the environment map [°]", "from_degrees:.0f to_degrees:.0f episodes:,", in_text=False)
def _yaws(statistics: Statistics) -> Rows:
    step = TURN / YAW_BINS
    for index, count in enumerate(statistics.lights.yaw if statistics.lights else ()):
        yield index * step, (index + 1) * step, count


@_table("light_exposure", "Episodes by exposure compensation [EV]", "from_EV:.1f episodes:,", in_text=False)
def _exposures(statistics: Statistics) -> Rows:
    yield from statistics.lights.exposure.items() if statistics.lights else ()


@_table(
    "looks",
    "Randomized looks: quantiles of what episodes have drawn",
    f"part parameter draws:, {' '.join(f'quantile_{share}:.3g:{share:.0%}' for share in LOOK_QUANTILES)}",
)
def _looks(statistics: Statistics) -> Rows:
    yield from ((row.part, row.parameter, row.draws, *row.quantiles) for row in statistics.looks)


@_table(
    "bins",
    "Bins and where they stand",
    "bin episodes:, fraction:.1% x_from_mm:.0f x_to_mm:.0f y_from_mm:.0f y_to_mm:.0f yaw_from_degrees:.0f yaw_to_degrees:.0f",
)
def _bins(statistics: Statistics) -> Rows:
    total = sum(use.episodes for use in statistics.bins.values())
    for name, use in statistics.bins.items():
        yield name, use.episodes, use.episodes / total, *(1e3 * end for end in (*use.x, *use.y)), *map(math.degrees, use.yaw)


@_table(
    "coverage",
    "Views by object and viewing direction in its frame",
    "object_id z_from z_to longitude_from longitude_to views",
    in_text=False,
)
def _coverage(statistics: Statistics) -> Rows:
    """Empty bins are left out."""
    heights = [2.0 * index / BANDS - 1.0 for index in range(BANDS + 1)]
    turns = [TURN * index / SECTORS - TURN / 2.0 for index in range(SECTORS + 1)]
    cells = [(*z, *turn) for z in pairwise(heights) for turn in pairwise(turns)]
    for each in statistics.objects:
        seen = zip(cells, each.coverage.bins, strict=True)
        yield from ((each.object_id, *(round(edge, 6) for edge in cell), count) for cell, count in seen if count)


NEAR = 50
"""Load from which a seal is near its limit [% of its break force]."""
MAX_TEXT_ROWS = 24
"""Rows of objects over time in text: of a longer table, evenly spread rows are shown."""


def to_json(statistics: Statistics) -> str:
    """Serialize all statistics as JSON: the fields of the dataclasses, and the derived numbers."""
    content = dataclasses.asdict(statistics)
    groups = zip((*content["groups"], content["total"]), (*statistics.groups, statistics.total), strict=True)
    for row, group in groups:
        row["annotations"]["instances_per_view"] = group.annotations.instances_per_view
        row["objects_over_time"] = [point._asdict() for point in group.objects_over_time]
    return json.dumps(content, allow_nan=False)


def write_csv(statistics: Statistics, folder: Path) -> list[Path]:
    """Write each table to `folder/NAME.csv`; the folder is new or empty, and appears with all files or not at all. Raises OutputError if
    the folder is not empty, or cannot be written."""
    partial = folder.with_name(f".{folder.name}.{os.getpid()}")
    tables = make_tables(statistics)
    try:
        make_folder(partial.parent)
        partial.mkdir()
        try:
            for table in tables:
                (partial / f"{table.name}.csv").write_text(to_csv(table), encoding="utf-8")
            partial.replace(folder)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    except (OSError, ValueError) as error:
        raise output_error(folder, error) if isinstance(error, OSError) else OutputError(f"cannot write {folder}: {error}") from error
    return [folder / f"{table.name}.csv" for table in tables]


def print_statistics(console: Console, statistics: Statistics, paper: bool | None = None) -> None:
    """Print the tables that are short enough, and what is missing; columns that do not fit the console's width follow below, none is cut.
    `paper`: whether the paper's numbers stand beside; None: if the objects are the paper's."""
    shown = statistics.has_paper_objects if paper is None else paper
    for table in make_tables(statistics):
        if table.in_text and (shown or table.name != PAPER):
            _print_table(console, table)
    for sentence in statistics.missing:
        if shown or sentence != OTHER_OBJECTS:
            console.print(f"missing: {escape(sentence)}", markup=False, soft_wrap=True)
    load = statistics.total.episodes.largest_load
    if load is not None and load < NEAR:
        line = f"no seal was loaded beyond {load} % of its break force: no pick depended on how strong suction is"
        console.print(line, markup=False, soft_wrap=True)
    if (rest := statistics.rest) is not None:
        line = f"piles that vibrate: {rest.vibrating:,} of {rest.windows:,} windows of {REST_WINDOW} s at rest have an object above"
        console.print(f"{line} {1e3 * REST_AMPLITUDE:g} mm/s, to and fro", markup=False, soft_wrap=True)
    if paper is None and statistics.paper and not shown:
        console.print("the objects are not those of the paper; --paper shows its numbers beside these", markup=False, soft_wrap=True)


def _print_table(console: Console, table: Table) -> None:
    """Print a table with its title, in blocks as wide as the terminal; a long timeline is thinned to MAX_TEXT_ROWS rows."""
    rows = table.rows
    if table.name == TIMELINE and len(rows) > MAX_TEXT_ROWS:
        rows = [rows[index * (len(rows) - 1) // (MAX_TEXT_ROWS - 1)] for index in range(MAX_TEXT_ROWS)]
    console.print(table.title, style="bold", markup=False, soft_wrap=True)
    for head, *lines in to_text(dataclasses.replace(table, rows=rows), console.width):
        console.print(Text(head, "dim"), soft_wrap=True)
        console.print(Text("\n".join([*lines, ""])), soft_wrap=True)
