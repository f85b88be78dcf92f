"""CPU cores that this process may use."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

from synpick_warp.system.hardware.control_groups import list_control_groups, read_text


def count_cores(root: Path = Path("/")) -> int:
    """Number of usable CPU cores: those of the affinity mask (`taskset`), at most the CPU quota of the control groups (`docker --cpus`).

    Args:
        root: Folder in which /proc and /sys lie; tests pass another one.
    """
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
