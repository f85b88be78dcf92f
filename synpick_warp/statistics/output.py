"""Statistics as text, JSON and CSV."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape as escape_markup
from rich.table import Table as TextTable

from synpick_warp.configs.check import escape
from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import output_error
from synpick_warp.statistics.compute import OTHER_OBJECTS, Statistics
from synpick_warp.statistics.tables import PAPER, TIMELINE, Table, Value, make_tables
from synpick_warp.system.folders import make_folder

MAX_TEXT_ROWS = 24
"""Rows of objects over time in text: of a longer table, evenly spread rows are shown."""
_COLUMN_GAP = 2
"""Space between columns of text [characters]."""
_FORMULA = ("=", "+", "-", "@")
"""First characters of a text that spreadsheets take for a formula (OWASP, CSV injection)."""


def to_json(statistics: Statistics) -> str:
    """Serialize all statistics as JSON: the fields of the dataclasses, and the derived numbers."""
    content = dataclasses.asdict(statistics)
    groups = zip((*content["groups"], content["total"]), (*statistics.groups, statistics.total), strict=True)
    for row, group in groups:
        row["annotations"]["instances_per_view"] = group.annotations.instances_per_view
        row["objects_over_time"] = [point._asdict() for point in group.objects_over_time]
    return json.dumps(content, allow_nan=False)


def to_csv(table: Table) -> str:
    """Serialize a table as CSV with a header."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([column.name for column in table.columns])
    writer.writerows([_plain(value) for value in row] for row in table.rows)
    return stream.getvalue()


def _plain(value: Value) -> Value:
    """A value for CSV; names cannot become formulas."""
    if isinstance(value, str):
        return f"'{escape(value)}" if value.startswith(_FORMULA) else escape(value)
    return value


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
    if paper is None and statistics.paper and not shown:
        console.print("the objects are not those of the paper; --paper shows its numbers beside these", markup=False, soft_wrap=True)


def _print_table(console: Console, table: Table) -> None:
    rows = table.rows
    if table.name == TIMELINE and len(rows) > MAX_TEXT_ROWS:
        rows = [rows[index * (len(rows) - 1) // (MAX_TEXT_ROWS - 1)] for index in range(MAX_TEXT_ROWS)]
    labels = [escape(column.name.replace("_", " ") if column.label is None else column.label) for column in table.columns]
    cells = [_cells(row, [column.style for column in table.columns]) for row in rows]
    widths = [max(map(cell_len, column)) + _COLUMN_GAP for column in zip(labels, *cells, strict=True)]
    console.print(table.title, style="bold", markup=False, soft_wrap=True)
    for block in _blocks(table, widths, console.width + _COLUMN_GAP):
        text = TextTable(box=None, header_style="dim", pad_edge=False)
        for index in block:
            text.add_column(escape_markup(labels[index]), justify="right" if table.columns[index].style else "left", no_wrap=True)
        for row in cells:
            text.add_row(*(escape_markup(row[index]) for index in block))
        # A single column may be wider than the console.
        console.print(text, width=max(console.width, sum(widths[index] for index in block)), soft_wrap=True, crop=False)
        console.print()


def _blocks(table: Table, widths: Sequence[int], width: int) -> Iterator[list[int]]:
    """Split a table's columns into blocks that fit a width; each begins with the columns that say what a row is, which are left-aligned."""
    keys = list(takewhile(lambda index: not table.columns[index].style, range(len(widths))))[: len(widths) - 1]
    block: list[int] = []
    for index in range(len(keys), len(widths)):
        if block and sum(widths[each] for each in (*keys, *block, index)) > width:
            yield [*keys, *block]
            block = []
        block.append(index)
    yield [*keys, *block]


def _cells(row: Iterable[Any], styles: list[str]) -> list[str]:
    return [
        "-" if value is None else escape(str(value)) if isinstance(value, str) else format(value, style)
        for value, style in zip(row, styles, strict=True)
    ]
