"""Free memory of GPUs and of the host, within the limits of control groups (cgroups), as containers have them.

Every number is an upper bound: caches that the system can reclaim, and swap, count as free.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import warp as wp

from synpick_warp.system.hardware.cores import list_control_groups, read_text

_UNLIMITED = 1 << 60
"""Control groups without a limit report "max", or a number above this [bytes]."""
_FILES = {
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
    2: ("memory.max", "memory.current", ("inactive_file", "active_file", "slab_reclaimable")),
}
"""Files of a control group by version: limit, use, and the keys of memory.stat that count caches."""


def free_device_memory(device: wp.Device) -> int:
    """Free memory of a GPU [bytes], including what Warp's memory pool keeps without using it: the pool has the size of its peak use."""
    with contextlib.suppress(RuntimeError):  # Memory may be too short for a context: left to the queries below, which raise then.
        _ = device.context  # Warp keeps it; without it each query would create a CUDA context and destroy it, which takes 0.9 s.
    free = device.free_memory
    if device.is_mempool_supported:
        free += max(0, wp.get_mempool_used_mem_high(device) - wp.get_mempool_used_mem_current(device))
    return min(free, device.total_memory)


def free_host_memory(root: Path = Path("/")) -> int:
    """Free memory of the host [bytes]: MemAvailable (without it: all memory), at most what each control group leaves; plus all free swap.
    `root`: folder in which /proc and /sys lie; tests pass another one."""
    table = _read_table(root / "proc/meminfo")
    # meminfo is in kibibytes. Without it, swap is unknown and counts as none.
    available, swap = table.get("MemAvailable:", 0) << 10, table.get("SwapFree:", 0) << 10
    if not available:
        available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([available, *_group_remainders(root)]) + swap


def _group_remainders(root: Path) -> Iterator[int]:
    """Memory that each control group of this process leaves [bytes]; groups without a limit are left out."""
    for version, group in list_control_groups("memory", root):
        limit_name, used_name, cached = _FILES[version]
        limit, used = (read_text(group / name).strip() for name in (limit_name, used_name))
        if limit.isdecimal() and used.isdecimal() and int(limit) < _UNLIMITED:
            table = _read_table(group / "memory.stat")
            yield max(0, int(limit) - int(used) + sum(table.get(name, 0) for name in cached))


def _read_table(path: Path) -> dict[str, int]:
    """Parse a table of lines that begin with a name and a number: name -> number."""
    words = (line.split() for line in read_text(path).splitlines())
    return {parts[0]: int(parts[1]) for parts in words if len(parts) > 1 and parts[1].isdecimal()}
