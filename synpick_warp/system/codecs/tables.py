"""Tables of named columns as text, CSV, LaTeX, and texts of cells for a page."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import NamedTuple

from rich.cells import cell_len

from synpick_warp.errors import escape

Value = int | float | str | None
"""Value of a cell; None: unknown."""
_GAP = 2
"""Space between columns of text [characters]."""
_FORMULA = ("=", "+", "-", "@")
"""First characters of a text that spreadsheets take for a formula (OWASP, CSV injection)."""
_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"} | {sign: f"\\{sign}" for sign in "&%$#_{}"}


class Column(NamedTuple):
    """Column of a table."""

    name: str
    """Header in CSV."""
    style: str = ""
    """Format of the values in text and LaTeX, such as ",", ".2f" or ".1%", which stand at the right; empty: text, at the left."""
    label: str | None = None
    """Header in text and LaTeX; None: the name, with spaces for underscores."""
    digits: str = ""
    """Format specification of the values in CSV; empty: full precision."""


def parse_columns(text: str) -> tuple[Column, ...]:
    """Columns from a list with spaces between: "name", "name:style" or "name:style:label", where underscores of a label become spaces."""
    parts = (each.split(":") for each in text.split())
    return tuple(Column(*each[:2], *(label.replace("_", " ") for label in each[2:])) for each in parts)


@dataclass(frozen=True)
class Table:
    """Table for text, CSV and LaTeX."""

    name: str
    """Name of the CSV file, without suffix."""
    title: str
    columns: tuple[Column, ...]
    rows: list[tuple[Value, ...]] = field(default_factory=list)
    in_text: bool = True
    """Whether it is short enough for text."""
    spans: tuple[tuple[str, range], ...] = ()
    """Headers above several columns each, one after the other, in LaTeX and in text that is not split."""
    sections: frozenset[int] = frozenset()
    """Rows above which text has a gap, and LaTeX a rule."""

    def labels(self) -> list[str]:
        """Headers of the columns in text and LaTeX."""
        return [column.name.replace("_", " ") if column.label is None else column.label for column in self.columns]

    def cells(self, unknown: str) -> list[list[str]]:
        """Values as text, in the format of their column; a missing value (None) becomes the text `unknown`."""
        return [[_format(value, column.style, unknown) for value, column in zip(row, self.columns, strict=True)] for row in self.rows]


def _format(value: Value, style: str, unknown: str) -> str:
    """Format a number by the specification `style`; text stays as it is, None becomes `unknown`."""
    return unknown if value is None else value if isinstance(value, str) else format(value, style)


def to_csv(table: Table, exact: bool = False) -> str:
    """A table as CSV with a header; unless names are to stay exact, they are escaped and cannot become formulas of a spreadsheet."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([column.name for column in table.columns])
    for row in table.rows:
        writer.writerow([_plain(value, column.digits, exact) for value, column in zip(row, table.columns, strict=True)])
    return stream.getvalue()


def _plain(value: Value, digits: str, exact: bool) -> Value:
    """Format a CSV cell: a number by `digits` (empty: unchanged); text is escaped, also against formulas, unless `exact`."""
    if isinstance(value, str):
        return value if exact else f"'{escape(value)}" if value.startswith(_FORMULA) else escape(value)
    return value if value is None or not digits else format(value, digits)


def to_latex(table: Table) -> str:
    """LaTeX table for booktabs: text in the first column, numbers in the others, grouped below the headers of `spans`."""
    heads = " & ".join(f"\\multicolumn{{{len(below)}}}{{c}}{{{_escape_latex(name)}}}" for name, below in table.spans)
    rules = "".join(f"\\cmidrule(lr){{{below[0] + 1}-{below[-1] + 1}}}" for _, below in table.spans)
    lines = [f"\\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}", "\\toprule", f" & {heads} \\\\", rules]
    lines.append(f"{' & '.join(table.labels())} \\\\")
    for number, row in enumerate(table.cells("--")):
        lines += ["\\midrule"] * (number in table.sections)
        lines.append(f"{' & '.join(map(_escape_latex, row))} \\\\")
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}"]) + "\n"


def _escape_latex(text: str) -> str:
    """Escape the ten special characters of LaTeX; all others, non-ASCII too, stay as they are."""
    return "".join(_LATEX.get(sign, sign) for sign in text)


def to_text(table: Table, width: int | None = None) -> Iterator[list[str]]:
    """Blocks of lines of a table in aligned columns, each with its header first. `width`: largest length of a line [characters], where a
    table of more columns is split into blocks; None: any."""
    rows = [[escape(cell) for cell in row] for row in (table.labels(), *table.cells("-"))]
    widths = [max(map(cell_len, column)) for column in zip(*rows, strict=True)]
    head = ""
    for name, below in table.spans:
        widths[below[0]] += max(0, cell_len(name) - _span(widths, below))
        head = _padded(head, _span(widths, range(below[0]))) + " " * _GAP + _padded(name, _span(widths, below))
    for block in [range(len(widths))] if width is None else _blocks(table, [each + _GAP for each in widths], width + _GAP):
        lines = [(" " * _GAP).join(_padded(row[index], widths[index], bool(table.columns[index].style)) for index in block) for row in rows]
        parted = [line for number, line in enumerate(lines, start=-1) for line in [""] * (number in table.sections) + [line]]
        yield [head.rstrip(), *parted] if table.spans and width is None else parted


def _span(widths: Sequence[int], columns: range) -> int:
    """Width of neighbouring columns with the gaps between them."""
    return sum(widths[index] for index in columns) + _GAP * (len(columns) - 1)


def _padded(text: str, width: int, right: bool = False) -> str:
    """Pad text with spaces to `width` terminal cells; `right`: align it at the right."""
    space = " " * (width - cell_len(text))
    return space + text if right else text + space


def _blocks(table: Table, widths: Sequence[int], width: int) -> Iterator[list[int]]:
    """Split a table's columns into blocks of at most `width` characters; each repeats the text columns on the left, which name the row."""
    keys = list(takewhile(lambda index: not table.columns[index].style, range(len(widths))))[: len(widths) - 1]
    block: list[int] = []
    for index in range(len(keys), len(widths)):
        if block and sum(widths[each] for each in (*keys, *block, index)) > width:
            yield [*keys, *block]
            block = []
        block.append(index)
    yield [*keys, *block]
