"""CPU cores that this process may use, control groups (cgroups) that limit it, and threads: a parallel map, names, and a check whether
others may launch Warp kernels."""

import math
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar


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

    A container sees its own group as the root. Folders may not exist. `controller`: "memory" or "cpu". `root`: folder in which /proc and
    /sys lie; tests pass another one."""
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


PIXELS, COPIES, LINK, SETUP = "pixels", "copies", "bake link", "setup"
"""Name prefixes of this package's threads. PIXELS threads launch kernels only while the caller waits; the others never do."""
ZARR_THREADS = {"async.concurrency": 1, "threading.max_workers": 1}
"""Configuration of zarr: one thread, as writer processes run in parallel. Zarr names its pool's threads only if the pool size is set."""
_HARMLESS = re.compile(
    rf"({PIXELS}|{COPIES}|{SETUP})_\d+|{LINK}|(upload|deliver)_\d+|delivery|heartbeat|zarr_(io|pool_\d+)|QueueFeederThread"
)
"""Names of threads that never launch kernels beside the caller: those above, those of bakes into stores, zarr's event loop and pool,
multiprocessing's queues."""
_HARMLESS_PACKAGES = ("rich", "tqdm", "ray")
"""Packages whose thread classes only refresh progress bars, or collect garbage."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def map_in_threads(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Parallel map with a thread pool, one thread per usable core. Results are in the order of the items.

    Use it for functions that spend their time in NumPy, OpenCV or image decoders, which release the interpreter lock. Functions must not
    launch kernels. If calls fail, the error of the first failed item is raised, and pending items are cancelled. A single item needs no
    thread, which takes some milliseconds.
    """
    given = list(items)
    if len(given) < 2:
        return [function(item) for item in given]
    with ThreadPoolExecutor(count_cores(), thread_name_prefix=SETUP) as pool:
        return list(pool.map(function, given))


def is_only_launcher() -> bool:
    """Whether the current thread is the only one that may launch kernels, that is, all other threads are known not to."""
    return all(
        thread is threading.current_thread()
        or _HARMLESS.fullmatch(thread.name)
        or type(thread).__module__.partition(".")[0] in _HARMLESS_PACKAGES
        for thread in threading.enumerate()
    )
