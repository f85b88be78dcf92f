"""Command-line options, report rows, tables and JSON output shared by all tools."""

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.files.load import COMMAND_LINE, load_config, parse_assignment
from synpick_warp.configs.schema import Config
from synpick_warp.errors import SynpickError

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 + SIGINT, as in shells."""


def writable_file(text: str) -> Path:
    """Argument type of an option (`add_argument(type=...)`): an output file in an existing folder, checked before measuring."""
    path = Path(text)
    if path.is_dir() or not path.parent.is_dir():
        reason = f"{path} is a folder" if path.is_dir() else f"there is no folder {path.parent}"
        raise argparse.ArgumentTypeError(f"{reason}; name a file in a folder that exists")
    return path


def positive_count(text: str) -> int:
    """Argument type of an option: an integer above 0."""
    if not text.isdecimal() or not 0 < int(text) <= INT32_MAX:
        raise argparse.ArgumentTypeError(f"{text} is no count; allowed: 1 to {INT32_MAX}")
    return int(text)


def counts(text: str) -> tuple[int, ...]:
    """Argument type of an option: integers above 0, comma-separated."""
    return tuple(positive_count(part) for part in text.split(","))


def existing_folder(text: str) -> Path:
    """Argument type of an option: the path of an existing folder."""
    path = Path(text)
    if not path.is_dir():
        raise argparse.ArgumentTypeError(f"there is no folder {path}; create it first")
    return path


def finite_amount(text: str) -> float:
    """Argument type of an option: a finite number from 0 on."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is out of range; allowed: finite numbers from 0 on")
    return value


def image_resolution(text: str) -> list[int | str]:
    """Argument type of an option: WIDTHxHEIGHT. Parts that are not numbers are reported by the check of `cameras.resolution`."""
    return [int(part) if part.isdecimal() else part for part in text.split("x")]


OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "config": {"metavar": "PRESET_OR_FILE", "help": "preset or .toml file (default: the default settings)"},
    "device": {"default": "auto", "help": "cpu, cuda:N or auto (default: auto)"},
    "models": {"default": "", "help": "folder of BOP models (default: the embedded objects)"},
    "lights": {"default": "", "help": "folder of light maps (default: the embedded skies)"},
    "seed": {"type": int, "default": 0, "help": "seed of all random numbers (default: 0)"},
    "size": {"type": image_resolution, "help": "WIDTHxHEIGHT of the images [px] (default: %(default)s)"},
    "set": {"action": "append", "default": [], "metavar": "SECTION.KEY=VALUE", "help": "any other setting; may be repeated"},
    "json": {"type": writable_file, "metavar": "FILE", "help": "also write the results to this file"},
}
"""Options with the same meaning in every tool, as arguments of `add_argument`."""
SETTINGS = {"device": "bake.device", "models": "bake.models", "lights": "bake.lights", "seed": "bake.seed", "size": "cameras.resolution"}
"""Setting that each shared option overrides."""


@dataclass(frozen=True)
class MeasuredRow:
    """Row of a report: measured value with unit, its bound (empty: none) and whether that holds."""

    name: str
    value: float
    unit: str = ""
    bound: str = ""
    holds: bool = True
    part: str = ""
    """Group that the row belongs to."""

    @property
    def verdict(self) -> str:
        """Result of the bound check: "holds" or "VIOLATED"; empty without a bound."""
        return "" if not self.bound else "holds" if self.holds else "VIOLATED"

    def to_dict(self) -> dict[str, Any]:
        """Fields for JSON; None for NaN and infinity, which JSON does not have."""
        return asdict(self) | {"value": self.value if math.isfinite(self.value) else None}


def of_part(part: str, rows: Iterable[MeasuredRow]) -> Iterator[MeasuredRow]:
    """Rows with `part` as the group of those that belong to none."""
    return (row if row.part else replace(row, part=part) for row in rows)


def make_parser(
    doc: str | None, *shared: str, own: Mapping[str, Mapping[str, Any]] | None = None, **defaults: object
) -> argparse.ArgumentParser:
    """Argument parser, described by the first line of the docstring `doc`, with options out of `OPTIONS` and further ones of the same form;
    `defaults` are those that differ from `OPTIONS`."""
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    for name, arguments in {**{name: OPTIONS[name] for name in shared}, **(own or {})}.items():
        parser.add_argument(f"--{name}", **arguments)
    parser.set_defaults(**defaults)
    return parser


def configure(options: argparse.Namespace, fixed: Mapping[str, object], defaults: Mapping[str, object] | None = None) -> Config:
    """Load the settings of a tool: `--config`, overridden by `defaults`, `--set`, then shared options (with `--config` those given), then
    by `fixed`. Raises ConfigError: a setting is unknown or out of its range."""
    overrides: dict[str, object] = dict(defaults or {}) | dict(parse_assignment(text) for text in options.set)
    preset = getattr(options, "config", None)
    for name, setting in SETTINGS.items():
        if hasattr(options, name) and (preset is None or getattr(options, name) != OPTIONS[name].get("default")):
            overrides[setting] = getattr(options, name)
    return load_config(preset, overrides | dict(fixed), source=COMMAND_LINE)


def make_names_parser(allowed: Iterable[str], noun: str) -> Callable[[str], tuple[str, ...]]:
    """Type (for `add_argument`) of an option that takes comma-separated names out of `allowed`; `noun` is for its error message."""
    choices = tuple(allowed)

    def parse(text: str) -> tuple[str, ...]:
        names = tuple(text.split(","))
        if unknown := [name for name in names if name not in choices]:
            raise argparse.ArgumentTypeError(f"no such {noun}: {', '.join(unknown)}; allowed: {', '.join(choices)}")
        return names

    return parse


def fail(tool: str, error: SynpickError | str) -> int:
    """Print a user error as one line; returns the exit code 2."""
    print(f"{tool}: {error}", file=sys.stderr)
    return 2


def print_rows(console: Console, heading: str, title: str, rows: Iterable[MeasuredRow]) -> None:
    """Print a table of rows with bounds and verdicts; whole numbers without a unit are printed as counts."""
    table = Table(heading, "", "unit", "bound", "", title=title)
    table.columns[1].justify = "right"
    for row in rows:
        count = row.unit == "" and float(row.value).is_integer()
        table.add_row(row.name, f"{row.value:.0f}" if count else f"{row.value:.3f}", row.unit, row.bound, row.verdict)
    console.print(table)


def write_json(path: Path | None, record: Any) -> None:
    """Write `record` as JSON to `path`; None: write nothing."""
    if path is not None:
        path.write_text(json.dumps(record, indent=1) + "\n")
