"""Processes that tests expect to end."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path


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
