"""Free memory of devices and of the host, which counts the limits of control groups (cgroups) of containers.

Every number is an upper bound: memory that the system can take back from caches, and swap, count as free.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import warp as wp

_UNLIMITED = 1 << 60
"""Control groups without a limit report "max", or a number above this [bytes]."""
_GROUPS = Path("/sys/fs/cgroup")


def free_device_memory(device: wp.Device) -> int:
    """Free memory of a GPU [bytes], with what this process's memory pool holds but does not use."""
    with contextlib.suppress(RuntimeError):  # If memory is too short for a context, the queries below raise.
        _ = device.context  # Warp keeps it; without it each query would create a CUDA context and destroy it, which takes 0.9 s.
    free = device.free_memory
    if device.is_mempool_supported:
        free += max(0, wp.get_mempool_used_mem_high(device) - wp.get_mempool_used_mem_current(device))
    return min(free, device.total_memory)


def free_host_memory(root: Path = Path("/")) -> int:
    """Free memory of the host [bytes]: what the kernel can make available, at most what the control groups leave, and free swap.

    Args:
        root: Folder in which /proc and /sys lie; tests pass another one.
    """
    table = _read_table(root / "proc/meminfo")
    # meminfo has kibibytes; machines without it have no swap that is known.
    available, swap = table.get("MemAvailable:", 0) << 10, table.get("SwapFree:", 0) << 10
    if not available:
        available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([available, *_group_limits(root)]) + swap


def _group_limits(root: Path) -> Iterator[int]:
    """Memory that each control group of this process leaves [bytes]; groups without a limit are left out."""
    groups = root / _GROUPS.relative_to("/")
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if controllers == "":  # Version 2 has one hierarchy for all controllers.
            yield from _walk(groups, path, "memory.max", "memory.current", ("inactive_file", "active_file", "slab_reclaimable"))
        elif "memory" in controllers.split(","):
            names = ("total_inactive_file", "total_active_file")
            yield from _walk(groups / "memory", path, "memory.limit_in_bytes", "memory.usage_in_bytes", names)


def _walk(folder: Path, path: str, limit_name: str, used_name: str, cached: tuple[str, ...]) -> Iterator[int]:
    """Free memory that each limited control group leaves, from the given group up to the root [bytes]; a container sees its own as root."""
    parts = [part for part in path.split("/") if part not in ("", "..")]
    for depth in range(len(parts), -1, -1):
        group = folder.joinpath(*parts[:depth])
        limit, used = _read(group / limit_name).strip(), _read(group / used_name).strip()
        if limit.isdigit() and used.isdigit() and int(limit) < _UNLIMITED:
            table = _read_table(group / "memory.stat")
            yield max(0, int(limit) - int(used) + sum(table.get(name, 0) for name in cached))


def _read_table(path: Path) -> dict[str, int]:
    """Numbers by name, of lines that begin with a name and a number."""
    words = (line.split() for line in _read(path).splitlines())
    return {parts[0]: int(parts[1]) for parts in words if len(parts) > 1 and parts[1].isdigit()}


def _read(path: Path) -> str:
    """Read a file of the kernel's interface (procfs, cgroupfs); empty text if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return ""
