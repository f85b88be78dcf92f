"""CPU cores that this process may use, and the control groups (cgroups) that limit it."""

import math
import os
from collections.abc import Iterator
from pathlib import Path


def count_cores(root: Path = Path("/")) -> int:
    """Number of usable CPU cores: those of the affinity mask (`taskset`), at most the CPU quota of the control groups (`docker --cpus`).
    `root`: folder in which /proc and /sys lie; tests pass another one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([cores, *(max(1, math.ceil(quota)) for quota in _list_quotas(root))])


def _list_quotas(root: Path) -> Iterator[float]:
    """CPU quota of each control group that has one [cores]."""
    for version, group in list_control_groups("cpu", root):
        if version == 1:
            words = [read_text(group / name).strip() for name in ("cpu.cfs_quota_us", "cpu.cfs_period_us")]
        else:
            words = read_text(group / "cpu.max").split()
        if len(words) == 2 and all(word.isdecimal() and int(word) for word in words):  # Else "max", or -1 in version 1: no quota.
            yield int(words[0]) / int(words[1])


_GROUPS = Path("sys/fs/cgroup")


def list_control_groups(controller: str, root: Path) -> Iterator[tuple[int, Path]]:
    """List the groups that limit this process: version (1 or 2) and folder of each, from its own group up to the root of the hierarchy.

    A container sees its own group as the root. Folders may not exist.

    Args:
        controller: "memory" or "cpu".
        root: Folder in which /proc and /sys lie; tests pass another one.
    """
    for line in read_text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        parts = [part for part in path.split("/") if part not in ("", "..")]
        if controllers == "":  # Version 2 has one hierarchy for all controllers.
            version, folder = 2, root / _GROUPS
        elif controller in controllers.split(","):
            version, folder = 1, root / _GROUPS / controller
        else:
            continue
        for depth in range(len(parts), -1, -1):
            yield version, folder.joinpath(*parts[:depth])


def read_text(path: Path) -> str:
    """Read a file of the kernel's interface (procfs, cgroupfs); empty text if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return ""
