"""Real clients: other people's readers open a small data set of ours, and what they have read is compared with what we have in memory.

Each client runs in a process of its own, in our interpreter or in the one that `--python NAME=PATH` names (more than once to try several
versions). Prints a table; a client that is not installed, or whose format the data set lacks, is listed as such. Exits with 1 if a client
disagrees or fails, with 2 if the data set cannot be opened. Nothing is fetched.

    python -m tools.clients DATA --python blender=BPY/bin/python --bop-toolkit DIR
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import synpick_warp
from synpick_warp.errors import SynpickError
from tools.clients.base import CLIENTS, MISSING, PICTURE, PSNR, Sources
from tools.figures import describe_run, write_run
from tools.options import Row, fail, make_names_parser, writable_file

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 900.0
"""Time limit of a client [s]; rendering by Cycles takes most."""
EQUAL, NOT_INSTALLED, NO_FORMAT = "equal", "not installed", "not in this data set"


@dataclass
class Result:
    """Row of the table of clients: name, version, what it read, agreement, remarks, and whether the check holds."""

    client: str
    version: str
    read: str
    agreement: str
    remarks: str
    holds: bool = True


def run_client(name: str, python: str, data: Path, data_set: Any, sources: Sources) -> Result:
    """Let one client read in its interpreter, and compare with the expected values; returns its row."""
    module = importlib.import_module(f"tools.clients.{name}")
    place = module.find(data, sources)
    if place is None:
        return Result(name, "", "", NO_FORMAT, "")
    with tempfile.TemporaryDirectory() as folder:
        command = (python, "-m", "tools.clients.reader", name, str(place), str(data), folder, json.dumps(asdict(sources)))
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
        try:
            done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=TIMEOUT)
        except OSError as error:
            return Result(name, "", "", NOT_INSTALLED, str(error))
        except subprocess.TimeoutExpired:
            return Result(name, "", place.name, f"no answer in {TIMEOUT:.0f} s", "", holds=False)
        last = (done.stderr.strip().splitlines() or [""])[-1]
        if done.returncode == MISSING:
            return Result(name, "", "", NOT_INSTALLED, f"missing: {last}")
        if done.returncode:
            return Result(name, "", place.name, "FAILED", last or f"exit code {done.returncode}", holds=False)
        report = json.loads((Path(folder) / "report.json").read_text())
        with np.load(Path(folder) / "values.npz") as values:
            agreement, holds = compare(module, dict(values), module.expect(data_set))
    version = ", ".join(f"{package} {number}".strip() for package, number in report["versions"].items() if number)
    return Result(name, version, report["what"], agreement, "; ".join(report["remarks"]), holds)


def compare(module: Any, read: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> tuple[str, bool]:
    """Compare what was read with what was expected, as text and verdict; only names that both have."""
    common = sorted(read.keys() & expected.keys())
    if not common:
        return "NOTHING TO COMPARE", False
    wrong, ratios, largest = [], [], 0.0
    for name in common:
        if name.startswith(PICTURE):
            ratios.append(psnr(getattr(module, "develop", lambda _, value: value)(name, read[name]), expected[name]))
            wrong += [name] if ratios[-1] < PSNR else []
            continue
        error = difference(read[name], expected[name])
        largest = max(largest, error)
        if not error <= getattr(module, "BOUNDS", {}).get(name.partition(" ")[0], 0.0):
            wrong.append(f"{name} by {error:.3g}")
    texts = [f"{len(common) - len(ratios)} values " + (EQUAL if largest == 0.0 else f"within {largest:.1g}")]
    texts += [f"picture {min(ratios):.1f} dB"] if ratios else []
    return (f"DIFFERS: {', '.join(wrong[:3])}", False) if wrong else ("; ".join(texts), True)


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """Largest absolute difference; infinite if shapes differ, 0 where both are NaN."""
    if first.shape != second.shape:
        return float("inf")
    numbers = [np.asarray(array, np.float64) for array in (first, second)]
    both = np.isnan(numbers[0]) & np.isnan(numbers[1])
    return float(np.where(both, 0.0, np.nan_to_num(np.abs(numbers[0] - numbers[1]), nan=np.inf)).max(initial=0.0))


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Peak signal-to-noise ratio of pictures from 0 to 1 [dB]; minus infinity if their sizes differ."""
    if first.shape != second.shape:
        return float("-inf")
    return float(-10.0 * np.log10(max(np.mean((first - second) ** 2), 1e-12)))


def interpreters(names: tuple[str, ...], given: list[str]) -> Iterator[tuple[str, str]]:
    """Client and interpreter of each row.

    Raises:
        ValueError: An option is not NAME=PATH with the name of a client.
    """
    chosen: dict[str, list[str]] = {}
    for text in given:
        name, _, path = text.partition("=")
        if name not in CLIENTS or not path:
            raise ValueError(f"--python is {text}; allowed: NAME=PATH, names: {', '.join(CLIENTS)}")
        chosen.setdefault(name, []).append(path)
    for name in names:
        for path in chosen.get(name, [sys.executable]):
            yield name, path


def print_table(console: Console, results: list[Result]) -> None:
    """Print one row a client."""
    table = Table("client", "version", "read", "agreement with memory", "remarks")
    for result in results:
        table.add_row(result.client, result.version, result.read, result.agreement, result.remarks, style="" if result.holds else "bold")
    console.print(table)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "data", type=Path, metavar="DATA", help="folder of the data set; all formats: --formats bop,shards,usd,zarr,lerobot"
    )
    parser.add_argument(
        "--clients", type=make_names_parser(CLIENTS, "client"), default=CLIENTS, help=f"of {','.join(CLIENTS)} (default: all)"
    )
    parser.add_argument("--python", action="append", default=[], metavar="NAME=PATH", help="interpreter of a client; may be repeated")
    parser.add_argument("--bop-toolkit", default="", metavar="DIR", help="folder of a copy of the BOP toolkit")
    parser.add_argument("--json", type=writable_file, metavar="FILE", help="also write the table to this file")
    given = parser.parse_args(arguments)
    try:
        chosen = list(interpreters(given.clients, given.python))
        data_set = synpick_warp.open(given.data)
        if not data_set:
            raise SynpickError(f"{given.data} has no episode")
    except (SynpickError, ValueError) as error:
        return fail("clients", str(error))
    sources = Sources(str(Path(given.bop_toolkit).resolve()) if given.bop_toolkit else "")
    results = [run_client(name, python, given.data.resolve(), data_set, sources) for name, python in chosen]
    print_table(Console(), results)
    rows = [Row(result.client, float(result.holds), bound="= 1", holds=result.holds) for result in results]
    write_run(given.json, describe_run("tools.clients", [], rows, clients=[asdict(result) for result in results]))
    return 0 if all(result.holds for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
