"""Figures: a run of a tool as JSON, and the table of current figures, those of the newest run of each stage in tools/results.

`--json FILE` of a tool writes a run. To publish it, copy the file to tools/results as TABLE_NAME.json, fill in `stage`, `limit` (one
clause), `conditions` and `shown` (names of the values in the table), and run `python -m tools.docs`.
"""

import datetime
import json
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from tools.options import MeasuredRow

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "tools" / "results"


class Run(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """One run of a tool: what was measured, when, on what, by which command, and the values."""

    stage: str = ""
    """What was measured; a newer run of the same stage replaces an older one in the table."""
    date: str | None
    """Day, YYYY-MM-DD; None: unknown."""
    card: str | None
    """Processor that limits: GPU, or CPU cores; None: unknown."""
    commit: str | None
    """Short hash of the code that ran; None: unknown."""
    command: str
    today: str = ""
    """Command that measures the same with the present code; empty: the same one."""
    conditions: str = ""
    """What the command does not say: other load on the host, where files lay, caches."""
    limit: str = ""
    """What limits the figure, one clause."""
    shown: list[str] = msgspec.field(default_factory=list)
    """Names of the rows in the table; empty: all."""
    machine: dict[str, str] = msgspec.field(default_factory=dict)
    """Versions, cores and memory, as `doctor` prints them."""
    more: dict[str, Any] = msgspec.field(default_factory=dict)
    """What a tool records besides rows."""
    rows: list[MeasuredRow]


def describe_run(tool: str, machine: Iterable[tuple[str, str]], rows: Iterable[MeasuredRow], **more: object) -> dict[str, Any]:
    """Run of the module `tool` as JSON, by the command line of this process. Absolute paths are written by their last names alone."""
    versions = dict(machine)
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    return {
        "stage": "",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "card": versions.get("device", "").partition(": ")[2] or None,
        "commit": _commit(),
        "command": f"python -m {tool} {shlex.join(words)}".strip(),
        "limit": "",
        "machine": versions,
        "more": more,
        "rows": [row.to_dict() for row in rows],
    }


def _commit() -> str | None:
    """Short hash of the checkout's commit, with "+" if files differ from it; None without git."""
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--exclude=*", "--dirty=+"], cwd=ROOT, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def read_runs(folder: Path = RESULTS) -> dict[str, Run]:
    """Runs of the files in a folder, by file name. Raises msgspec.ValidationError: a file is no run."""
    return {path.name: msgspec.json.decode(path.read_bytes(), type=Run) for path in sorted(folder.glob("*.json"))}


def newest_runs(runs: Mapping[str, Run]) -> dict[str, Run]:
    """Newest run of each stage, by file name; runs without a date are the oldest."""
    newest: dict[str, str] = {}
    for name, run in runs.items():
        if run.stage not in newest or (run.date or "") > (runs[newest[run.stage]].date or ""):
            newest[run.stage] = name
    return {name: runs[name] for name in newest.values()}


def figures_tables(runs: Mapping[str, Run]) -> dict[str, str]:
    """Markdown of the newest runs: a table for each first word of the file names, with the conditions as numbered notes below."""
    newest = newest_runs(runs)
    groups = dict.fromkeys(name.partition("_")[0] for name in newest)
    return {group: _table({name: run for name, run in newest.items() if name.partition("_")[0] == group}) for group in groups}


def _table(runs: Mapping[str, Run]) -> str:
    """Markdown table of the runs, with their conditions as numbered notes."""
    lines = ["| what | figures | measured on | limited by |", "|---|---|---|---|"]
    notes: dict[str, int] = {}
    for name, run in runs.items():
        numbers = sorted(notes.setdefault(part, len(notes) + 1) for part in run.conditions.split("; ") if part)
        where = f"[{run.card or '?'}, {run.date or 'no date'}](results/{name})" + (f" ({', '.join(map(str, numbers))})" if numbers else "")
        figures = "; ".join(_show(row) for row in run.rows if not run.shown or row.name in run.shown)
        lines.append(f"| {run.stage} | {figures} | {where} | {run.limit} |")
    return "\n".join([*lines, *([f"\n{'; '.join(f'({number}) {note}' for note, number in notes.items())}."] if notes else [])])


def _show(row: MeasuredRow) -> str:
    """Name and value of a row in Markdown."""
    unit = {"1/s": "/s", "1/h": "/h", "%": " %", "": ""}.get(row.unit, f" {row.unit}")
    return f"{row.name} **{row.value:,.10g}{unit}**".strip()


def write_run(path: Path | None, run: Mapping[str, Any]) -> None:
    """Write a run as JSON to `path`, a row a line; None: write nothing."""
    if path is not None:
        rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in run["rows"])
        head = json.dumps({name: value for name, value in run.items() if name != "rows"}, indent=1, ensure_ascii=False)
        path.write_text(f'{head[:-2]},\n "rows": [\n{rows}\n ]\n}}\n', encoding="utf-8")
