"""Threads of this process, told apart by whether they may launch kernels at any time."""

from __future__ import annotations

import re
import threading

PIXELS, COPIES, LINK = "pixels", "copies", "bake link"
"""Names of this package's threads: PIXELS launch kernels only while the caller waits, the others launch none."""
_HARMLESS = re.compile(rf"({PIXELS}|{COPIES})_\d+|{LINK}|zarr_(io|pool_\d+)|QueueFeederThread")
"""Names of threads that launch no kernels of their own accord: ours, zarr's loop and pool, multiprocessing's queues."""
_HARMLESS_PACKAGES = ("rich", "tqdm")
"""Packages whose classes of threads draw progress bars."""


def is_only_launcher() -> bool:
    """Whether no other thread may launch kernels meanwhile: all others have harmless names or draw progress bars."""
    return all(
        thread is threading.current_thread()
        or _HARMLESS.fullmatch(thread.name)
        or type(thread).__module__.partition(".")[0] in _HARMLESS_PACKAGES
        for thread in threading.enumerate()
    )
