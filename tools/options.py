"""Command-line options, result rows, tables and JSON output that all tools share."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from synpick_warp.configs.load import COMMAND_LINE, load_config, parse_assignment
from synpick_warp.configs.schema import Config
from synpick_warp.errors import SynpickError

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "device": {"default": "auto", "help": "cpu, cuda:N or auto (default: auto)"},
    "models": {"default": "", "help": "folder of BOP models (default: the embedded objects)"},
    "lights": {"default": "", "help": "folder of light maps (default: the embedded skies)"},
    "seed": {"type": int, "default": 0, "help": "seed of all random numbers (default: 0)"},
    "set": {"action": "append", "default": [], "metavar": "SECTION.KEY=VALUE", "help": "any other setting; may be repeated"},
    "json": {"type": Path, "metavar": "FILE", "help": "also write the numbers to this file"},
}
"""Options that mean the same in every tool."""
SETTINGS = {"device": "bake.device", "models": "bake.models", "lights": "bake.lights", "seed": "bake.seed"}
"""Shared options that are settings."""


@dataclass(frozen=True)
class Row:
    """One line of a report: a measured number and, where it must keep one, its bound."""

    name: str
    value: float
    unit: str = ""
    bound: str = ""
    holds: bool = True
    part: str = ""
    """Group of lines that it belongs to."""

    @property
    def verdict(self) -> str:
        """Whether the bound holds; empty without a bound."""
        return "" if not self.bound else "holds" if self.holds else "VIOLATED"

    def record(self) -> dict[str, Any]:
        """Fields for JSON, which has no NaN."""
        return asdict(self) | {"value": self.value if math.isfinite(self.value) else None}


def make_parser(doc: str | None, *shared: str) -> argparse.ArgumentParser:
    """Parser described by the first line of a module's docstring, with these of the shared options."""
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    for name in shared:
        parser.add_argument(f"--{name}", **OPTIONS[name])
    return parser


def configure(options: argparse.Namespace, fixed: Mapping[str, object], defaults: Mapping[str, object] | None = None) -> Config:
    """Settings of a tool: its own defaults, then `--set`, then shared options and what the tool fixes.

    Raises:
        ConfigError: A setting is unknown or out of its range.
    """
    overrides: dict[str, object] = dict(defaults or {}) | dict(parse_assignment(text) for text in options.set)
    overrides |= {setting: getattr(options, name) for name, setting in SETTINGS.items() if hasattr(options, name)}
    return load_config(None, overrides | dict(fixed), source=COMMAND_LINE)


def names_of(allowed: Iterable[str], noun: str) -> Callable[[str], tuple[str, ...]]:
    """Type of an option that takes several names, separated by commas."""
    choices = tuple(allowed)

    def parse(text: str) -> tuple[str, ...]:
        names = tuple(text.split(","))
        if unknown := [name for name in names if name not in choices]:
            raise argparse.ArgumentTypeError(f"no such {noun}: {', '.join(unknown)}; allowed: {', '.join(choices)}")
        return names

    return parse


def fail(tool: str, error: SynpickError | str) -> int:
    """Print a user's mistake as one line; returns the exit code."""
    print(f"{tool}: {error}", file=sys.stderr)
    return 2


def print_machine(console: Console, machine: Iterable[tuple[str, str]]) -> None:
    """Print what a measurement ran on."""
    table = Table(show_header=False, box=None)
    for name, value in machine:
        table.add_row(name, value)
    console.print(table)


def print_rows(console: Console, heading: str, title: str, rows: Iterable[Row]) -> None:
    """Print rows with bounds and verdicts; numbers without a unit are counts."""
    table = Table(heading, "", "unit", "bound", "", title=title)
    table.columns[1].justify = "right"
    for row in rows:
        count = row.unit == "" and float(row.value).is_integer()
        table.add_row(row.name, f"{row.value:.0f}" if count else f"{row.value:.3f}", row.unit, row.bound, row.verdict)
    console.print(table)


def write_json(path: Path | None, record: Any) -> None:
    """Write a record, if a file was named."""
    if path is not None:
        path.write_text(json.dumps(record, indent=1) + "\n")
