"""Helpers to wait for, inspect and kill processes."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path


def module_command(name: str) -> list[str]:
    """Command that runs a module of tests without collections, which take 2 s of CPU while it imports Warp and Newton."""
    return [sys.executable, "-c", f"import gc, runpy; gc.disable(); runpy.run_module({name!r}, run_name='__main__', alter_sys=True)"]


def wait_for(condition: Callable[[], bool], timeout: float = 600.0) -> None:
    """Wait until a condition holds; fails after `timeout` seconds."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def children(process: int) -> list[int]:
    """Ids of a process's children."""
    return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def kill_at(process: int, folder: Path, files: int, writer: bool) -> None:
    """Kill a bake's process once its folder has a number of files; with `writer` its last child process, if any. Returns early if the bake
    ends."""
    with contextlib.suppress(ProcessLookupError, FileNotFoundError):
        while sum(len(names) for *_, names in os.walk(folder)) < files:
            os.kill(process, 0)
            time.sleep(0.01)
        os.kill(([process, *children(process)] if writer else [process])[-1], signal.SIGKILL)


def wait_until_gone(pids: Iterable[int], timeout: float = 30.0) -> None:
    """Wait until no process of these runs any more; a zombie does not run."""
    deadline = time.monotonic() + timeout
    while running := [pid for pid in pids if _runs(pid)]:
        assert time.monotonic() < deadline, running
        time.sleep(0.02)


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def crash(*_: object) -> None:
    """Stands in for a decoder that a file crashes; here, since the process of an isolated call imports the function's module."""
    os.kill(os.getpid(), signal.SIGSEGV)
