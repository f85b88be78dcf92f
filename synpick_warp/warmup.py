"""Ahead-of-time compilation of all kernels that a bake launches, into Warp's kernel cache; collision shapes go into theirs on the way."""

from __future__ import annotations

import dataclasses
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.codes import Status
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.registry import load_exporter_classes
from synpick_warp.pipeline import Factory, build_factory
from synpick_warp.progress import Progress
from synpick_warp.stages.stream import TickReader

POLL = 0.5
"""Polling interval of the kernel cache [s]."""
BINARIES = ("*.cubin", "*.ptx", "*.o")
"""Compiled modules in Warp's kernel cache."""


@dataclass(frozen=True)
class WarmUp:
    """Result of a warm-up."""

    compiled: int
    """Modules that were compiled; the others were in the cache."""
    seconds: float
    """Duration [s]."""


class CompilationWatch:
    """Monitor of the kernel cache: counts the modules that are compiled while its block runs, and reports them."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.cache = Path(wp.config.kernel_cache_dir or "")
        self._before = self._binaries()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def compiled(self) -> int:
        """Modules compiled so far."""
        return len(self._binaries() - self._before)

    def _binaries(self) -> set[tuple[Path, int]]:
        """Paths and modification times [ns] of all binaries."""
        found = (path for pattern in BINARIES for path in self.cache.glob(f"*/{pattern}"))
        return {(path, path.stat().st_mtime_ns) for path in found if path.exists()}

    def _watch(self) -> None:
        shown = 0
        while not self._ended.wait(POLL):
            if (compiled := self.compiled) > shown:
                shown = compiled
                self.progress.stage(f"compiling kernels: {compiled} modules so far")


def warm_up(config: Config, progress: Progress) -> WarmUp:
    """Compile what a bake with these settings compiles: run two ticks and render a view of as few worlds as a device simulates.

    Nothing is written but caches. Kernels depend on the settings only by which of them are used (mode, renderer, layers, formats).

    Args:
        config: All settings.
        progress: Receives the stages and the number of compiled modules.

    Raises:
        SynpickError: As `synpick_warp.bake`.
    """
    started = time.perf_counter()
    kinds = load_exporter_classes(config.bake.formats)
    small = dataclasses.replace(config, bake=dataclasses.replace(config.bake, worlds=1))
    needs = [any(getattr(kind, name) for kind in kinds) for name in ("needs_physics", "needs_images")]
    factory = build_factory(small, progress, [0], *needs)
    with CompilationWatch(progress) as watch:
        _launch_all(factory, renders=any(kind.needs_views for kind in kinds))
    return WarmUp(watch.compiled, time.perf_counter() - started)


def _launch_all(factory: Factory, renders: bool) -> None:
    """Launch every kernel of simulation, perception, renderer and encoders once."""
    simulation = factory.simulation
    record = simulation.records[0]
    for _ in range(2):  # A GPU runs the first tick kernel by kernel, and captures the graph of the second.
        simulation.tick(record)
    if simulation.perception is not None:
        simulation.perception.load_kernels(record.snapshot)
    reader = TickReader(record)
    reader.start()
    report = reader.wait()
    if renders:
        report.status[:, Status.LIVE] = 1
        for views in factory.stream.render(record.snapshot, report):
            len(views)
    wp.synchronize_device(simulation.device)
