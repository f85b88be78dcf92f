"""Processes of clients in their interpreters, and the table of what became of them."""

import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tools.figures import describe_run, write_run
from tools.options import MeasuredRow

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 900.0
"""Time limit of a client [s]; rendering by Cycles takes most."""
NOT_INSTALLED, ALL = "not installed", "all"
_MISSING = ("ModuleNotFoundError", "PackageNotFoundError", "ImportError")


@dataclass
class Result:
    """Result of one client library: name, version, what it read, agreement, remarks, and whether the check holds."""

    client: str
    version: str = ""
    read: str = ""
    agreement: str = ""
    remarks: str = ""
    holds: bool = True


def run_module(client: str, python: str, module: str, *arguments: str) -> tuple[Result, str]:
    """Run a module of this checkout with a client's Python interpreter. Returns the client's result and its output. If the client is not
    installed, fails or prints no result, `agreement` states the reason, and the output is empty."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
    command = (python, "-m", module, client, *arguments)
    try:
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=TIMEOUT)
    except OSError as error:
        return Result(client, agreement=NOT_INSTALLED, remarks=str(error)), ""
    except subprocess.TimeoutExpired:
        return Result(client, agreement=f"no answer in {TIMEOUT:.0f} s", holds=False), ""
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        is_missing = last.startswith(_MISSING)
        return Result(client, agreement=NOT_INSTALLED if is_missing else "FAILED", remarks=last, holds=is_missing), ""
    return Result(client), done.stdout


def interpreters(names: Iterable[str], every: tuple[str, ...], given: list[str]) -> Iterator[tuple[str, str]]:
    """Name and interpreter of each row: the one of this process, or those of options NAME=PATH, where a name may be "all". Raises
    ValueError: an option is not NAME=PATH with the name of a client."""
    chosen: dict[str, list[str]] = {}
    for text in given:
        name, _, path = text.partition("=")
        if name not in (*every, ALL) or not path:
            raise ValueError(f"--python is {text}; allowed: NAME=PATH, names: {', '.join((*every, ALL))}")
        chosen.setdefault(name, []).append(path)
    for name in names:
        for path in chosen.get(name) or chosen.get(ALL) or [sys.executable]:
            yield name, path


def finish(tool: str, json_file: Path | None, results: list[Result]) -> int:
    """Print one row a client, and write them; returns the exit code, 1 if one disagrees or fails."""
    table = Table("client", "version", "read", "agreement", "remarks")
    for result in results:
        table.add_row(result.client, result.version, result.read, result.agreement, result.remarks, style="" if result.holds else "bold")
    Console().print(table)
    rows = [MeasuredRow(result.client, float(result.holds), bound="= 1", holds=result.holds) for result in results]
    write_run(json_file, describe_run(tool, [], rows, clients=[asdict(result) for result in results]))
    return 0 if all(result.holds for result in results) else 1
