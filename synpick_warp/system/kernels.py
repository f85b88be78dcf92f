"""Parallel ahead-of-time compilation of Warp modules: a dry run lists the modules that launches need, and a thread pool compiles them.

Warp compiles each module when one of its kernels is first launched, one after the other. Listing them first gives their number, for
progress, and lets compilers run in parallel; Warp generates their source code under a lock.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import warp as wp

from synpick_warp.system.cores import count_cores

MAX_COMPILERS = 8
"""Maximum number of compiling threads: the longest module of a bake takes a quarter of all, so that more gain little."""
_LOCK_FILE = ".synpick-warp.lock"
"""Lock file in Warp's kernel cache; see `compilation_lock`."""
BINARIES = ("*.cubin", "*.ptx", "*.o")
"""Compiled modules in Warp's kernel cache."""


def list_binaries() -> set[tuple[Path, int]]:
    """Paths and modification times [ns] of all compiled modules in the kernel cache."""
    found = (path for pattern in BINARIES for path in Path(wp.config.kernel_cache_dir or "").glob(f"*/{pattern}"))
    return {(path, path.stat().st_mtime_ns) for path in found if path.exists()}


class ModuleBuild(NamedTuple):
    """Build of a Warp module: one device and one block size."""

    module: wp.Module
    device: str
    block: int

    def is_cached(self) -> bool:
        """Whether the kernel cache has it."""
        name = self.module._get_compile_output_name(wp.get_device(self.device), block_dim=self.block)
        return Path(wp.config.kernel_cache_dir or "", self.module.get_module_identifier(self.block), name).exists()


@contextlib.contextmanager
def compilation_lock(wait: Callable[[], None]) -> Iterator[None]:
    """Lock of Warp's kernel cache (flock): of several processes that start with a cold cache one compiles, and the others get its kernels.

    File systems without locks are used unlocked.

    Args:
        wait: Called before waiting for another process.
    """
    try:
        handle = os.open(Path(wp.config.kernel_cache_dir or "", _LOCK_FILE), os.O_CREAT | os.O_RDONLY | os.O_CLOEXEC, 0o666)
    except OSError:
        yield
        return
    try:
        if not _lock(handle, fcntl.LOCK_NB):
            wait()
            _lock(handle)
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_UN)  # Closing alone would leave it to children that were forked meanwhile.
        os.close(handle)


def _lock(handle: int, flags: int = 0) -> bool:
    """Take a lock; False: another process has it, and `flags` says not to wait."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | flags)
    except BlockingIOError:
        return False
    except OSError:
        pass  # A file system without locks.
    return True


def build_of(kernel: Any, device: wp.Device) -> ModuleBuild:
    """The build that a launch of a kernel with the default block size loads."""
    return ModuleBuild(kernel.module, device.alias, kernel.module.options["block_dim"] if device.is_cuda else 1)


class DryLaunches:
    """Dry run of kernel launches, by replacing `wp.Module.load`: in all threads kernels neither load nor run; copies and fills do run.

    Attributes:
        builds: Modules that the launches need, in the order of their first launch.
    """

    def __init__(self) -> None:
        self.builds: dict[ModuleBuild, None] = {}
        self._load: Any = None

    def __enter__(self) -> Self:
        self._load, builds = wp.Module.load, self.builds

        def record(module: wp.Module, device: Any, block_dim: int | None = None, *_: object, **__: object) -> None:
            block = module.options["block_dim"] if block_dim is None else block_dim
            builds[ModuleBuild(module, wp.get_device(device).alias, block)] = None

        wp.Module.load = record  # type: ignore[method-assign]
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        wp.Module.load = self._load  # type: ignore[method-assign]


def compile_modules(builds: Collection[ModuleBuild], report: Callable[[int, int], None], last: ModuleBuild | None = None) -> int:
    """Compile and load in parallel the modules that the kernel cache lacks, in a thread pool.

    Args:
        builds: Modules; those in the cache are loaded by their first launch.
        last: One of them that is compiled after all others; None: any.
        report: Progress callback (ready, total), called in this thread from (0, total) on; not called if nothing is missing.

    Returns:
        The number of compiled modules.
    """
    missing = [build for build in builds if not build.is_cached()]
    if not missing:
        return 0
    with ThreadPoolExecutor(min(len(missing), count_cores(), MAX_COMPILERS), thread_name_prefix="compile") as pool:
        report(0, len(missing))
        try:
            first = [pool.submit(one.module.load, one.device, one.block) for one in missing if one != last]
            for ready, done in enumerate(as_completed(first), 1):
                done.result()
                report(ready, len(missing))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if last is not None and last in missing:
        last.module.load(last.device, last.block)
        report(len(missing), len(missing))
    return len(missing)
