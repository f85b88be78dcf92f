"""Statistics as text, JSON and CSV."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path

from rich.console import Console
from rich.text import Text

from synpick_warp.apps.statistics.columns import REST_AMPLITUDE, REST_WINDOW
from synpick_warp.apps.statistics.compute import OTHER_OBJECTS
from synpick_warp.apps.statistics.figures import Statistics
from synpick_warp.apps.statistics.tables import PAPER, TIMELINE, make_tables
from synpick_warp.errors import OutputError, escape
from synpick_warp.exporters.writing.files import output_error
from synpick_warp.system.codecs.tables import Table, to_csv, to_text
from synpick_warp.system.inputs.paths import make_folder

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
    """Write each table to `folder/NAME.csv`; the folder is new or empty, and appears with all files or not at all.

    Raises:
        OutputError: The folder is not empty, or cannot be written.
    """
    check_csv_folder(folder)
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


def check_csv_folder(folder: Path) -> None:
    """Check that a folder is new or empty.

    Raises:
        OutputError: It is not, or it is a file or a link.
    """
    try:
        if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
            raise OutputError(f"--csv is {folder}; allowed: a new or an empty folder")
    except (OSError, ValueError) as error:
        raise OutputError(f"--csv is {folder}: {getattr(error, 'strerror', None) or error}") from None


def print_statistics(console: Console, statistics: Statistics, paper: bool | None = None) -> None:
    """Print the tables that are short enough, and what is missing.

    Args:
        console: Where to; columns that do not fit its width follow below, none is cut.
        statistics: The statistics.
        paper: Whether the paper's numbers stand beside; None: if the objects are the paper's.
    """
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
