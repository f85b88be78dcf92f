"""Integration tests of the environment with libraries of reinforcement learning, unpatched: two iterations, or their own checks.

Each client runs in a process of its own, in our interpreter or in the one that `--python NAME=PATH` names. Prints a table; a client that is
not installed is listed as such. Exits with 1 if a client fails. Nothing is fetched; an interpreter for all of them:
`pip install gymnasium torch skrl torchrl rsl-rl-lib stable-baselines3 tensorboard synpick-warp`.

    python -m tools.clients.environments --python all=VENV/bin/python
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tools.figures import describe_run, write_run
from tools.options import Row, fail, writable_file

ROOT = Path(__file__).resolve().parents[3]
NAMES = ("gymnasium", "statistics", "skrl", "torchrl", "rsl_rl", "stable_baselines3")
"""Clients: keys of `training.CLIENTS`, a module that only the client's process imports."""
TIMEOUT = 900.0
"""Time limit of a client [s]."""
MISSING = ("ModuleNotFoundError", "PackageNotFoundError")
ALL = "all"


@dataclass
class Result:
    """Row of the table: client, version, remark or error, and whether the client works (or is not installed)."""

    client: str
    version: str
    remark: str
    holds: bool = True


def run_client(name: str, python: str, device: str) -> Result:
    """Run a client in a process of its interpreter; returns its row."""
    command = (python, "-m", "tools.clients.environments.training", name, device)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
    try:
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=TIMEOUT)
    except OSError as error:
        return Result(name, "", f"not installed: {error}")
    except subprocess.TimeoutExpired:
        return Result(name, "", f"no answer in {TIMEOUT:.0f} s", holds=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [""])[-1]
        is_missing = last.startswith(MISSING)
        return Result(name, "", f"not installed: {last}" if is_missing else f"FAILED: {last}", holds=is_missing)
    answer = next(line for line in reversed(done.stdout.splitlines()) if "\t" in line)
    version, _, remark = answer.partition("\t")
    return Result(name, version, remark)


def interpreters(given: list[str]) -> dict[str, str]:
    """Interpreter of each client; raises ValueError if an option is not NAME=PATH with the name of a client, or "all"."""
    chosen: dict[str, str] = dict.fromkeys(NAMES, sys.executable)
    for text in given:
        name, _, path = text.partition("=")
        if name not in (*NAMES, ALL) or not path:
            raise ValueError(f"--python is {text}; allowed: NAME=PATH, names: {', '.join((*NAMES, ALL))}")
        chosen |= dict.fromkeys(NAMES if name == ALL else (name,), path)
    return chosen


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--python", action="append", default=[], metavar="NAME=PATH", help="interpreter of a client, or of all")
    parser.add_argument("--device", default="cpu", help="device of the worlds (default: cpu)")
    parser.add_argument("--json", type=writable_file, metavar="FILE", help="also write the table to this file")
    given = parser.parse_args(arguments)
    try:
        chosen = interpreters(given.python)
    except ValueError as error:
        return fail("environments", str(error))
    results = [run_client(name, python, given.device) for name, python in chosen.items()]
    table = Table("client", "version", "result")
    for result in results:
        table.add_row(result.client, result.version, result.remark, style="" if result.holds else "bold")
    Console().print(table)
    rows = [Row(result.client, float(result.holds), bound="= 1", holds=result.holds) for result in results]
    write_run(given.json, describe_run("tools.clients.environments", [], rows, clients=[asdict(result) for result in results]))
    return 0 if all(result.holds for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
