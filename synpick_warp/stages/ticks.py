"""Double-buffered tick loop: the device simulates tick t + 1 while tick t is rendered, copied and read."""

from __future__ import annotations

import contextlib
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.sim.simulate import RECORDS, Simulation
from synpick_warp.stages.stream import TickReader, TickReport
from synpick_warp.stages.timing import scope

HIGH_PRIORITY = -1
"""CUDA stream priority of physics: its 25,000 short kernels a tick wait for each other, and should not also wait for the renderer's."""


class TickLoop:
    """Tick loop of a simulation, one tick ahead; a context manager, which starts the first tick and at its end waits for the last.

    On a GPU physics has a stream of its own. A tick is enqueued there behind all work that the device's current stream has been given by
    then, so a record is not overwritten while it is rendered; what other streams read of a record must be awaited by the current stream.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.readers = [TickReader(record) for record in simulation.records]
        device = simulation.device
        self.stream = wp.Stream(device, priority=HIGH_PRIORITY) if device.is_cuda else None
        self._current = 0

    def __enter__(self) -> Self:
        self._simulate(self._current)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Wait for the tick that was simulated ahead: its arrays are freed by another stream."""
        if self.stream is not None:
            with contextlib.suppress(RuntimeError):  # A failed device; the error that ends the loop tells it.
                wp.synchronize_stream(self.stream)

    def advance(self) -> tuple[TickReport, Snapshot]:
        """Enqueue the tick after the next, and wait for the next one's report; its snapshot is valid until the following call."""
        current = self._current
        self._current = (current + 1) % RECORDS
        self._simulate(self._current)
        with scope("wait for tick"):
            report = self.readers[current].wait()
        return report, self.simulation.records[current].snapshot

    def _simulate(self, record: int) -> None:
        """Enqueue a tick and the copy of its report."""
        simulation = self.simulation
        with wp.ScopedStream(self.stream):
            with scope("simulate", simulation.device):
                simulation.tick(simulation.records[record])
            self.readers[record].start()
