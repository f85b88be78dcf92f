"""Benchmark of the online generator: its views per second against the bare renderer, and against the bare loop of simulation and
rendering."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.factory.assembly import Factory, Stages
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.online.selection import Selection
from synpick_warp.online.stream import Producer, ViewStream
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.online.batches import BatchRing, ViewBatch
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views, pair_views
from synpick_warp.stages.stream import TickReport
from synpick_warp.stages.ticks import TickLoop
from synpick_warp.system.progress import SilentProgress
from tools.options import Row

ROUNDS = 5
"""Alternations between the two loops of a comparison."""


class _StillProducer(Producer):
    """Producer without simulation: renders one tick repeatedly."""

    def __init__(self, still: TickReport, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.still = still

    def batches(self) -> Iterator[ViewBatch]:
        """Yield batches of the same, kept tick without end."""
        while True:
            yield from self.render(self.still, self.stages.simulation.record.snapshot)


class _UnloggedProducer(Producer):
    """Producer without the log of episodes: attempts may have begun before the benchmark."""

    def _end_episodes(self, report: TickReport) -> None:
        """Do nothing: no episode is logged."""
        return


def measure_stream(factory: Factory, report: TickReport, min_seconds: float) -> Iterator[Row]:
    """Benchmark of batches of one tick, and of ticks.

    Args:
        factory: Worlds in the middle of acting, and renderer.
        report: Report of the last tick, with the worlds that are rendered marked as live.
        min_seconds: Time for which a measurement is repeated, at least [s].
    """
    device, config = factory.simulation.device, factory.config
    ring = BatchRing(factory.groups[0], config.render.layers, config.bop.depth_scale)
    parts = (factory, (ring,), Selection().resolve(len(factory.cameras)), BakeSummary(), SilentProgress())
    yield Row("views in a batch", ring.views, "")
    still = ViewStream(_StillProducer(report, *parts))
    sources = {"renderer alone": _render_loop(factory, ring, report), "stream of one tick": map(_consumer(device), still)}
    yield from _compare(sources, device, min_seconds)
    sources = {
        "simulation and renderer alone": _tick_loop(factory, ring),
        "stream of ticks": map(_consumer(device), ViewStream(_UnloggedProducer(*parts))),
    }
    yield from _compare(sources, device, min_seconds)


def _compare(sources: dict[str, Iterator[int]], device: wp.Device, min_seconds: float) -> Iterator[Row]:
    """Rows of the views per second of two sources, which take turns, and of the second's rate in percent of the first's.

    Args:
        sources: Name -> iterator over the numbers of views that it makes.
        device: Device that makes them.
        min_seconds: Time for each source, at least [s]; it should be many times that of a tick.
    """
    totals = {name: [0.0, 0.0] for name in sources}
    for _ in range(ROUNDS):
        for name, source in sources.items():
            for index, value in enumerate(_count(source, device, min_seconds / ROUNDS)):
                totals[name][index] += value
    rates = {name: views / seconds for name, (views, seconds) in totals.items()}
    if not all(rates.values()):
        return  # All episodes have ended.
    for name, rate in rates.items():
        yield Row(f"{name}, views", rate, "1/s")
    (alone, own), (name, rate) = rates.items()
    yield Row(f"{name}: of {alone}", 100.0 * rate / own, "%")


def _render_loop(stages: Stages, ring: BatchRing, report: TickReport) -> Iterator[int]:
    """Render the views of one tick repeatedly into one buffer; yields the number of views of each batch."""
    snapshot, (world, camera) = stages.simulation.record.snapshot, select_views(report, len(stages.cameras))
    while True:
        yield from _render_all(stages, ring, snapshot, world, camera)


def _render_all(stages: Stages, ring: BatchRing, snapshot: Snapshot, world: np.ndarray, camera: np.ndarray) -> Iterator[int]:
    """Render the views in batches into one slot of the ring; yields the number of views of each."""
    slot = ring.slots[0]
    for views in batch_views(world, camera, ring.views, stages.groups[0].renderer):
        stages.groups[0].renderer.render(snapshot, views, slot.images, slot.layers)
        yield views.count


def select_views(report: TickReport, cameras: int) -> tuple[np.ndarray, np.ndarray]:
    """World and camera of each view of a tick, as of `pair_views`."""
    return pair_views(np.flatnonzero(report.column("live")), np.arange(cameras))


def batch_views(world: np.ndarray, camera: np.ndarray, size: int, renderer: Renderer) -> Iterator[Any]:
    """Split views into batches of at most `size`; yields a struct `Views` for each. `world` and `camera` are (view) int32."""
    for first in range(0, len(world), size):
        rows = [wp.array(values[first : first + size], dtype=wp.int32, device=renderer.scene.device) for values in (world, camera)]
        yield make_views(rows[0], rows[1], len(rows[0]), renderer.instances)


def _consumer(device: wp.Device) -> Callable[[ViewBatch], int]:
    """Make a consumer that imports colour and ids through DLPack on a CUDA stream of its own, and returns the number of views of a
    batch."""
    stream = wp.Stream(device) if device.is_cuda else None

    def consume(batch: ViewBatch) -> int:
        with wp.ScopedStream(stream, sync_enter=False):
            wp.from_dlpack(batch.color)
            wp.from_dlpack(batch.instance)
        return len(batch)

    return consume


def _count(source: Iterator[int], device: wp.Device, min_seconds: float) -> tuple[float, float]:
    """Views made in at least `min_seconds` after one warm-up batch, and the elapsed time with synchronization of the device [s].

    The count ends early if the source does.
    """
    next(source, None)
    wp.synchronize_device(device)
    started, views = time.perf_counter(), 0
    for count in source:
        views += count
        if time.perf_counter() - started >= min_seconds:
            break
    wp.synchronize_device(device)
    return views, time.perf_counter() - started


def _tick_loop(stages: Stages, ring: BatchRing) -> Iterator[int]:
    """Simulate and render, tick by tick as a bake does, into one buffer; yields the number of views of each batch."""
    with TickLoop(stages.simulation) as ticks:
        while True:
            report, snapshot = ticks.advance()
            if (report.column("phase") == Phase.IDLE).all():
                return
            world, camera = select_views(report, len(stages.cameras))
            for views in _render_all(stages, ring, snapshot, world, camera):
                ticks.enqueue()
                yield views
