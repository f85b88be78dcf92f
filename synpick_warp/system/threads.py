"""Inventory of the threads of this process: which of them may launch kernels."""

from __future__ import annotations

import re
import threading

PIXELS, COPIES, LINK = "pixels", "copies", "bake link"
"""Names of this package's threads: PIXELS launch kernels only while the caller waits, the others launch none."""
ZARR_THREADS = {"async.concurrency": 1, "threading.max_workers": 1}
"""Configuration of zarr: one thread, since the writer processes are the parallelism. Its thread pool is named only if its size is set."""
_HARMLESS = re.compile(rf"({PIXELS}|{COPIES})_\d+|{LINK}|zarr_(io|pool_\d+)|QueueFeederThread")
"""Names of threads that launch no kernels of their own accord: ours, zarr's event loop and pool, multiprocessing's queues."""
_HARMLESS_PACKAGES = ("rich", "tqdm")
"""Packages with thread classes of their own, which draw progress bars."""


def is_only_launcher() -> bool:
    """Whether the current thread is the only one that may launch kernels: all others are on the list of harmless ones."""
    return all(
        thread is threading.current_thread()
        or _HARMLESS.fullmatch(thread.name)
        or type(thread).__module__.partition(".")[0] in _HARMLESS_PACKAGES
        for thread in threading.enumerate()
    )
