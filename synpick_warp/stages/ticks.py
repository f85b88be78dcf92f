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
"""Parts of a tick, of which most are substeps, that are enqueued when the report of the one before is awaited. On an H200 some 40 of 66 fit
into a stream's queue, which then blocks the host: the renderer idled for 0.25 s a tick while all parts were enqueued at once."""
PARTS_PER_BATCH = 4
"""Parts of a tick to enqueue per batch of views: beside a renderer they take about as long as the batch."""


class TickLoop:
    """Tick loop of a simulation, one tick ahead; a context manager, which starts the first tick and at its end waits for the last.

    On a GPU physics has a stream of its own. A tick is enqueued there behind all work that the device's current stream has been given by
    its begin, so a record is not overwritten while it is rendered; what other streams read of a record must be awaited by the current one.
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
        """Wait for the tick that was simulated ahead: its arrays are freed by another stream."""
        self._parts = iter(())
        if self.stream is not None:
            with contextlib.suppress(RuntimeError):  # A failed device; the error that ends the loop tells it.
                wp.synchronize_stream(self.stream)

    def advance(self) -> tuple[TickReport, Snapshot]:
        """Begin the tick after the next, and wait for the next one's report; its snapshot is valid until the following call."""
        self.enqueue()
        current = self._current
        self._current = (current + 1) % RECORDS
        self._begin(self._current)
        with scope("wait for tick"):
            report = self.readers[current].wait()
        return report, self.simulation.records[current].snapshot

    def enqueue(self, parts: int | None = None) -> None:
        """Enqueue parts of the tick that `advance` began, while its caller consumes the one before; None: all that are left."""
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
