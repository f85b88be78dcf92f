"""Double-buffered tick loop: the device simulates tick t + 1 while tick t is rendered, copied and read."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.sim.simulate import RECORDS, Simulation
from synpick_warp.stages.stream import TickReader, TickReport
from synpick_warp.stages.timing import scope

HIGH_PRIORITY = -1
"""CUDA stream priority of physics: its 25,000 short kernels a tick wait for each other, and should not also wait for the renderer's."""
PARTS_AHEAD = 24
"""Parts of the next tick, mostly substeps, that are enqueued before waiting for the report of this one. On an H200 some 40 of 66 parts
fill a stream's queue, and further launches block the host: with all parts at once the renderer idled for 0.25 s a tick."""
PARTS_PER_BATCH = 4
"""Parts of a tick to enqueue per batch of views: beside a renderer they take about as long as the batch."""


class TickLoop:
    """Tick loop of a simulation, one tick ahead; a context manager, which starts the first tick and at its end waits for the last.

    On a GPU physics has its own CUDA stream. Each tick waits for all work that was queued on the device's current stream when the tick
    began, so that no record is overwritten while it is rendered. Work on other streams that reads a record must be awaited by the
    current stream before the next `advance`.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.readers = [TickReader(record) for record in simulation.records]
        device = simulation.device
        self.stream = wp.Stream(device, priority=HIGH_PRIORITY) if device.is_cuda else None
        self._current = 0
        self._parts: Iterator[None] = iter(())
        """What is left to enqueue of the latest tick."""

    def __enter__(self) -> Self:
        self._begin(self._current)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Discard the parts of the tick that are not yet enqueued, and wait for its stream, before other streams free the tick's arrays.

        The simulation may stop in the middle of a tick, and cannot be continued.
        """
        self._parts = iter(())
        if self.stream is not None:
            with contextlib.suppress(RuntimeError):  # A failed device; the error that ends the loop tells it.
                wp.synchronize_stream(self.stream)

    def advance(self) -> tuple[TickReport, Snapshot]:
        """Begin tick t + 1, wait for tick t, and return its report and snapshot; the snapshot is valid until the next call."""
        self.enqueue()
        current = self._current
        self._current = (current + 1) % RECORDS
        self._begin(self._current)
        with scope("wait for tick"):
            report = self.readers[current].wait()
        return report, self.simulation.records[current].snapshot

    def enqueue(self, parts: int | None = None) -> None:
        """Enqueue the next `parts` parts of the tick that `advance` began, None: all. Call it between batches, while rendering tick t."""
        with wp.ScopedStream(self.stream, sync_enter=False), scope("simulate", self.simulation.device):
            for _ in itertools.islice(self._parts, parts):
                pass

    def _begin(self, record: int) -> None:
        """Begin a tick: enqueue its first parts."""
        if self.stream is not None:
            self.stream.wait_stream(self.simulation.device.stream)
        self._parts = self._run_tick(record)
        self.enqueue(PARTS_AHEAD)

    def _run_tick(self, record: int) -> Iterator[None]:
        """Enqueue a tick and the copy of its report, in parts."""
        yield from self.simulation.tick_parts(self.simulation.records[record])
        self.readers[record].start()
