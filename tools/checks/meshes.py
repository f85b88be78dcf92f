"""Batch import of third-party mesh files: which load, which load with a warning, which are refused and why.

Each file is read in a process of its own with a time limit, since readers of damaged files may crash or hang.

    python -m tools.checks.meshes FOLDER...
"""

from __future__ import annotations

import multiprocessing
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from synpick_warp.errors import SynpickError
from synpick_warp.scenes.assets.meshes import SUFFIXES, MeshOptions, read_mesh
from tools.options import make_parser, number_in

LOADS, WARNS, REFUSES, FAILS = KINDS = ("loads", "warns", "refuses", "fails")
"""Outcomes; the last is a fault of the program: a traceback, a crash or a time-out."""


class MeshOutcome(NamedTuple):
    """Outcome of reading a mesh file: its kind, and the message."""

    kind: str
    text: str


def read(file: Path) -> MeshOutcome:
    """Read a mesh file as the catalog does, in metres and centred; returns whether it loads, warns, is refused or fails."""
    said: list[str] = []
    try:
        read_mesh(file, 1.0, MeshOptions(center=True), said.append)
    except SynpickError as error:
        return MeshOutcome(REFUSES, str(error))
    except Exception as error:
        return MeshOutcome(FAILS, repr(error))
    said = [line for line in said if ": centred: moved by" not in line or ";" in line]
    return MeshOutcome(WARNS if said else LOADS, " ".join(said))


def _send(file: Path, pipe: Any) -> None:
    """Read a mesh file in a process, and send the outcome through a pipe."""
    pipe.send(read(file))


def read_apart(file: Path, seconds: float) -> MeshOutcome:
    """Read a file in a child process."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_send, args=(file, sender))
    child.start()
    sender.close()
    try:
        return receiver.recv() if receiver.poll(seconds) else MeshOutcome(FAILS, f"not read within {seconds:g} s")
    except EOFError:
        return MeshOutcome(FAILS, f"its reader ended with code {child.exitcode}")
    finally:
        child.kill()
        child.join()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns 1 if a file made the program fail."""
    parser, console = make_parser(__doc__), Console(soft_wrap=True, highlight=False)
    parser.add_argument("folders", nargs="+", type=Path, help="folders, searched with all below them")
    parser.add_argument("--seconds", type=number_in(0.0), default=60.0, help="time limit a file (default: 60)")
    options, counts = parser.parse_args(arguments), Counter[tuple[str, str]]()
    for file in sorted(file for folder in options.folders for file in folder.rglob("*") if file.suffix.lower() in SUFFIXES):
        kind, text = read_apart(file, options.seconds)
        counts[file.suffix.lower(), kind] += 1
        console.print(f"{kind:8} {file}  {text.replace(f'{file}: ', '')}", markup=False)
    for suffix in SUFFIXES:
        console.print(suffix, ", ".join(f"{counts[suffix, kind]} {kind}" for kind in KINDS))
    return 1 if any(kind == FAILS for _, kind in counts) else 0


if __name__ == "__main__":
    sys.exit(main())
