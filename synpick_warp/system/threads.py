"""Names and checks of the threads of this process that may launch Warp kernels."""

from __future__ import annotations

import re
import threading

PIXELS, COPIES, LINK = "pixels", "copies", "bake link"
"""Name prefixes of this package's threads. PIXELS threads launch kernels only while the caller waits; the others never do."""
ZARR_THREADS = {"async.concurrency": 1, "threading.max_workers": 1}
"""Configuration of zarr: one worker thread, as writer processes already run in parallel. Zarr names its pool's threads only if the
pool size is set."""
_HARMLESS = re.compile(rf"({PIXELS}|{COPIES})_\d+|{LINK}|zarr_(io|pool_\d+)|QueueFeederThread")
"""Names of threads that never launch kernels beside the caller: those above, zarr's event loop and pool, multiprocessing's queues."""
_HARMLESS_PACKAGES = ("rich", "tqdm")
"""Packages whose thread classes only refresh progress bars."""


def is_only_launcher() -> bool:
    """Whether the current thread is the only one that may launch kernels, that is, all other threads are known not to."""
    return all(
        thread is threading.current_thread()
        or _HARMLESS.fullmatch(thread.name)
        or type(thread).__module__.partition(".")[0] in _HARMLESS_PACKAGES
        for thread in threading.enumerate()
    )
