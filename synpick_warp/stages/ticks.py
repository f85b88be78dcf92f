"""Tick loop with a bounded lead: the device simulates following ticks while earlier ones are rendered, copied and read."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.host_copies import wait_event
from synpick_warp.stages.render_streams import HIGH_PRIORITY
from synpick_warp.stages.sim.physics import ENDED
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReport
from synpick_warp.stages.tick_queue import TickQueue, queue_lead, record_bytes
from synpick_warp.stages.timing import scope

PARTS_IN_FLIGHT = 24
"""Most parts of ticks, mostly substeps, that are enqueued and not yet done. On an H200 some 40 parts fill the launch queue of a CUDA
stream, and further launches block the host: with all 66 parts of a tick at once it launched no rendering for 0.25 s a tick."""

PHYSICS_SHARE = 2.0 / 11.0
"""Fraction of a GPU's multiprocessors (SMs) reserved for physics while it is the bottleneck: 24 of 132. Its kernels are short and fill few
SMs, but a renderer occupies all of them, so that each kernel waits for a free one and shares its caches. Measured on an H200 in a bake of
150 worlds in full HD, views/s at ticks/s of physics that runs ahead freely: 1,020 at 2.40 without reserved SMs, 1,036 at 2.31 with 8, 977
at 3.15 with 16, 929 at 3.64 with 24; 1,146 without physics."""
SAFE_LEAD = 512
"""Lead of physics [ticks] below which it counts as the bottleneck; at most half of the maximum lead. As worlds fall idle, rendering becomes
cheaper and a tick of physics hardly does, so that physics needs a reserve of ticks."""


class TickLoop:
    """Producer of ticks that runs ahead of its renderer; a context manager, whose exit waits for the parts that are enqueued.

    On a GPU physics has its own CUDA stream. While episodes wait for a free world it is at most one tick ahead, which suffices to overlap
    the two. Then worlds fall idle one by one, and a tick has fewer views to render, but physics takes nearly as long: from there on it may
    be ahead by up to `max_lead` ticks, so that the renderer has a backlog when physics becomes the slower of the two. On a CPU physics and
    renderer alternate.

    Before the next `advance`, make the device's current stream wait for every other stream that still reads the snapshot.
    """

    def __init__(self, simulation: Simulation, max_lead: int | None = None) -> None:
        """Allocate the queue.

        Args:
            simulation: The worlds.
            max_lead: Most ticks that physics may ever be ahead; None: by `queue_lead`.
        """
        self.simulation, self.device = simulation, simulation.device
        self.max_lead = queue_lead(record_bytes(simulation.record), self.device) if max_lead is None else max_lead
        self.lead = min(1, self.max_lead)
        if len(simulation.episodes) <= simulation.layout.worlds:
            self.lead = self.max_lead
        self.queue = TickQueue(simulation.record, self.max_lead + 1)
        self.stream = wp.Stream(self.device, priority=HIGH_PRIORITY) if self.device.is_cuda else None
        self._parts: Iterator[None] | None = None
        """What is left to enqueue of the tick begun last; None: nothing."""
        self._enqueued = self._simulated = self._taken = 0
        """Ticks that are enqueued as a whole, that were observed to be done, and that `advance` has returned."""
        self._all_idle = False
        """Whether all worlds were idle in the last tick observed to be done."""
        self._has_waited = False
        """Whether the last `advance` had to wait for physics."""
        self._running: deque[wp.Event] = deque()
        """Events at the ends of the parts that may still be running, oldest first."""
        self._spare: list[wp.Event] = []

    def __enter__(self) -> Self:
        if self.stream is not None:
            self.stream.wait_stream(self.device.stream)  # That one zero-fills the arrays.
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Discard the parts that are not yet enqueued, and wait for physics' stream, before other streams free its arrays.

        The simulation may stop in the middle of a tick, and cannot be continued.
        """
        self._parts = None
        if self.stream is not None:
            with contextlib.suppress(RuntimeError):  # A failed device; the next call to it raises the error.
                wp.synchronize_stream(self.stream)

    def advance(self) -> tuple[TickReport, Snapshot]:
        """Wait for the next tick, and return its report and snapshot, which are valid until the next call.

        While it waits, it enqueues parts of the following ticks, so that the device also has work until the next call.
        """
        tick = self._taken
        if tick:
            self.queue.release(tick - 1)
        self._taken += 1
        with self._physics_scope():
            while self._enqueued <= tick:
                self._enqueue_part()
        self.enqueue()
        self._has_waited = self.queue.phase(tick) is None
        while self._running and self.queue.phase(tick) is None:
            with scope("wait for part"):
                wait_event(self._running[0])
            self.enqueue()
        with scope("wait for tick"):
            return self.queue.get(tick)

    def enqueue(self) -> None:
        """Enqueue parts of the following ticks, as many as keep the device busy. Call it between batches of views."""
        while self._running and self._running[0].is_complete:
            self._spare.append(self._running.popleft())
        self._poll_finished_ticks()
        with self._physics_scope():
            while len(self._running) < PARTS_IN_FLIGHT and (self._parts is not None or self._may_begin()):
                self._enqueue_part()

    @property
    def reserved_share(self) -> float:
        """Fraction of the multiprocessors to reserve for physics: PHYSICS_SHARE while physics is the bottleneck, else 0."""
        if self._all_idle:
            return 0.0
        is_short = self._simulated - self._taken < min(SAFE_LEAD, self.lead // 2)
        return PHYSICS_SHARE if self._has_waited or is_short else 0.0

    def _poll_finished_ticks(self) -> None:
        """Read the phases of the ticks that the device has done since the last call."""
        while self._simulated < self._enqueued and (phase := self.queue.phase(self._simulated)) is not None:
            self._simulated += 1
            is_idle = phase == Phase.IDLE
            self._all_idle = bool(is_idle.all())
            if is_idle.any():
                self.lead = self.max_lead

    def _may_begin(self) -> bool:
        """Whether a further tick may begin before `advance` asks for it."""
        return not self._all_idle and self._enqueued < self._taken + self.lead

    @contextlib.contextmanager
    def _physics_scope(self) -> Iterator[None]:
        """Make physics' stream the current one, and profile what is enqueued on it."""
        with wp.ScopedStream(self.stream, sync_enter=False), scope("simulate", self.device):
            yield

    def _enqueue_part(self) -> None:
        """Enqueue the next part; with the last one of a tick, also the copy of the record into the queue."""
        self._parts = self._parts or self.simulation.tick_parts()
        if next(self._parts, ENDED) is ENDED:
            self.queue.put(self._enqueued)
            self._parts = None
            self._enqueued += 1
        if self.stream is not None:
            event = self._spare.pop() if self._spare else wp.Event(self.device)
            self._running.append(self.stream.record_event(event))
