"""CPU time, resident and anonymous memory of a benchmark and of its descendant processes, from /proc."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

_PARENT, _USER, _SYSTEM, _RESIDENT = 1, 11, 12, 21
"""Indices in /proc/PID/stat after the command's name: parent process, CPU time in user mode and in system mode [clock ticks], resident
memory [pages]."""


class Usage(NamedTuple):
    """Resources of processes: CPU time [s], resident memory and its part without shared memory and files [bytes]."""

    cpu: float = 0.0
    """CPU time in user mode and in the kernel [s]."""
    resident: int = 0
    """Resident memory [bytes]; memory that processes share, such as the slots through which writers get images, counts in each."""
    anonymous: int = 0
    """Resident memory of the process's own [bytes]: without shared memory and files."""

    def plus(self, other: Usage) -> Usage:
        """Sum of the resources of two."""
        return Usage(self.cpu + other.cpu, self.resident + other.resident, self.anonymous + other.anonymous)


def measure_usage() -> dict[int, Usage]:
    """Resources of this process and of its running descendants, by process id."""
    usages: dict[int, Usage] = {}
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                values = (entry / "stat").read_text().rpartition(")")[2].split()
                status = (entry / "status").read_text()
            except OSError:
                continue
            cpu = (int(values[_USER]) + int(values[_SYSTEM])) / os.sysconf("SC_CLK_TCK")
            usages[int(entry.name)] = Usage(cpu, int(values[_RESIDENT]) * os.sysconf("SC_PAGE_SIZE"), _anonymous_bytes(status))
            parents[int(entry.name)] = int(values[_PARENT])
    return {pid: usage for pid, usage in usages.items() if _descends(pid, os.getpid(), parents)}


def _anonymous_bytes(status: str) -> int:
    """Anonymous resident memory of /proc/PID/status [bytes]; 0 for processes that have ended and kernel threads."""
    match = re.search(r"^RssAnon:\s*(\d+) kB$", status, re.MULTILINE)
    return 1024 * int(match[1]) if match else 0


def _descends(pid: int, ancestor: int, parents: dict[int, int]) -> bool:
    """True if a process is the ancestor or one of its descendants."""
    while pid in parents and pid != ancestor:
        pid = parents[pid]
    return pid == ancestor
