"""Thread utilities: a parallel map, thread names, and a check whether other threads may launch Warp kernels."""

import re
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from synpick_warp.system.hardware.cores import count_cores

PIXELS, COPIES, LINK, SETUP = "pixels", "copies", "bake link", "setup"
"""Name prefixes of this package's threads. PIXELS threads launch kernels only while the caller waits; the others never do."""
ZARR_THREADS = {"async.concurrency": 1, "threading.max_workers": 1}
"""Configuration of zarr: one worker thread, as writer processes already run in parallel. Zarr names its pool's threads only if the
pool size is set."""
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
    launch kernels. If calls fail, the error of the first failed item is raised, and pending items are cancelled.
    """
    with ThreadPoolExecutor(count_cores(), thread_name_prefix=SETUP) as pool:
        return list(pool.map(function, items))


def is_only_launcher() -> bool:
    """Whether the current thread is the only one that may launch kernels, that is, all other threads are known not to."""
    return all(
        thread is threading.current_thread()
        or _HARMLESS.fullmatch(thread.name)
        or type(thread).__module__.partition(".")[0] in _HARMLESS_PACKAGES
        for thread in threading.enumerate()
    )
