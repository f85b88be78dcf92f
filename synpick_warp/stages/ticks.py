"""Tick loop with a bounded lead: the device simulates later ticks while earlier ones are rendered, copied and read. Between physics and
renderer is a queue of ticks: a ring buffer of snapshots on the device and of reports in pinned host memory."""

import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from types import TracebackType
from typing import Any, Self

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.stages.arrays import allocate_like
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.sim.physics import ENDED
from synpick_warp.stages.sim.simulate import Simulation, TickRecord
from synpick_warp.stages.sim.step_log import record_arrays
from synpick_warp.stages.stream import TickReader, TickReport
from synpick_warp.stages.timing import scope
from synpick_warp.stages.view_ring import wait_event
from synpick_warp.system.hardware.device import HIGH_PRIORITY, count_reserved
from synpick_warp.system.interpreter import collection_paused

PARTS_IN_FLIGHT = 24
"""Maximum number of parts of ticks, usually substeps, that are enqueued and not yet done. Some 40 parts fill the launch queue of a CUDA
stream, and further launches block the host, which then cannot launch rendering."""

PHYSICS_SHARE = 2.0 / 11.0
"""Fraction of a GPU's multiprocessors (SMs) reserved for the solver while physics is the bottleneck: 24 of 132. Its kernels are short and
small, but the renderer occupies all SMs: each kernel waits for a free one, and competes for its caches."""
SAFE_LEAD = 512
"""Physics counts as the bottleneck while its lead is smaller than this [ticks], or than half of the permitted lead if that is less. As
worlds become idle, rendering a tick gets faster but simulating one hardly does, so that the renderer needs a backlog."""
SOLVER_WORLDS = 8
"""Maximum number of worlds per reserved SM for which the solver is restricted to these SMs. On an H200 512 worlds take
1.8 times as long on 24 SMs as on all, 150 worlds 1.1 times, which they gain beside a renderer."""


class TickLoop:
    """Runs physics ahead of the renderer. Use it as a context manager; exiting waits for the work that is enqueued.

    On a GPU physics has its own CUDA stream. While episodes wait for a free world it is at most one tick ahead, which suffices to overlap
    the two. Once none waits and a world is idle, or from the start if all episodes fit, it may be ahead by up to `max_lead` ticks: worlds
    fall idle one by one, and a tick has fewer views to render, but takes physics nearly as long, so that the renderer needs a backlog. On
    a CPU physics and renderer alternate. Idle worlds run what `more` returns, and the lead is one tick again.

    Before the next `advance`, which releases the snapshot on the device's current stream, make that stream wait for every other stream that
    still reads it.
    """

    def __init__(self, simulation: Simulation, max_lead: int | None = None, more: Callable[[bool], Sequence[int]] = lambda _: ()) -> None:
        """Allocate the queue.

        `max_lead` is the maximum number of ticks by which physics may ever be ahead; None: by `queue_lead`. `more` is called before a tick
        begins while worlds are idle: further episodes, or none now. True: all worlds are idle in the tick last taken, and it may wait."""
        self.simulation, self.device = simulation, simulation.device
        self.max_lead = queue_lead(record_bytes(simulation.record), self.device) if max_lead is None else max_lead
        self.lead = min(1, self.max_lead)
        if len(simulation.episodes) <= simulation.layout.worlds:
            self.lead = self.max_lead
        self.queue = TickQueue(simulation.record, self.max_lead + 1)
        self.stream = wp.Stream(self.device, priority=HIGH_PRIORITY) if self.device.is_cuda else None
        self._more, self._refilled, self._has_idle = more, 0, False
        """The source of episodes, the first tick with the episodes that it returned last, and whether it or a later one had idle worlds."""
        self._parts: Iterator[None] | None = None
        """Remaining parts of the tick that is being enqueued, or None."""
        self._enqueued = self._simulated = self._taken = 0
        """Numbers of ticks: fully enqueued, observed to be done, and requested by `advance`."""
        self._busy_worlds = simulation.layout.worlds
        """Worlds that were not idle in the last tick observed to be done."""
        self._has_waited = False
        """Whether the last `advance` had to wait for physics."""
        self._running: deque[wp.Event] = deque()
        """Events at the ends of the parts that may still be running, oldest first."""
        self._spare: list[wp.Event] = []
        """Events for reuse."""

    def __enter__(self) -> Self:
        if self.stream is not None:
            self.stream.wait_stream(self.device.stream)  # The current stream zero-fills the arrays.
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Discard the parts that are not yet enqueued, and wait for physics' stream, before other streams free its arrays.

        The simulation may stop in the middle of a tick, and cannot be continued.
        """
        self._parts = None
        if self.stream is not None:
            with contextlib.suppress(RuntimeError):  # The device failed; the next call to it raises the error.
                wp.synchronize_stream(self.stream)

    def advance(self) -> tuple[TickReport, Snapshot]:
        """Wait for the next tick, and return its report and snapshot, which are valid until the next call.

        While it waits, it enqueues parts of the following ticks, which keep the device busy until the next call.
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
        """Enqueue further parts, up to PARTS_IN_FLIGHT, without blocking. Call it between batches of views."""
        while self._running and self._running[0].is_complete:
            self._spare.append(self._running.popleft())
        self._poll_finished_ticks()
        with self._physics_scope():
            while len(self._running) < PARTS_IN_FLIGHT and (self._parts is not None or self._may_begin()):
                self._enqueue_part()

    @property
    def reserved_share(self) -> float:
        """Fraction of the multiprocessors to reserve for the solver: PHYSICS_SHARE while physics is the bottleneck, else 0."""
        if not self._busy_worlds:
            return 0.0
        is_short = self._simulated - self._taken < min(SAFE_LEAD, self.lead // 2)
        return PHYSICS_SHARE if self._has_waited or is_short else 0.0

    def confine_solver(self, stream: wp.Stream | None) -> None:
        """Set the SMs of the solver, from the next tick on: the reserved ones, which the CUDA stream is on, or None: all. All are also used
        while more than SOLVER_WORLDS worlds per reserved SM are busy."""
        if stream is not None and self._busy_worlds > SOLVER_WORLDS * count_reserved(self.device, PHYSICS_SHARE):
            stream = None
        self.simulation.physics.solver_stream = stream

    def _poll_finished_ticks(self) -> None:
        """Update the counters and the lead from the ticks that the device has completed since the last call."""
        while self._simulated < self._enqueued and (phase := self.queue.phase(self._simulated)) is not None:
            self._simulated += 1
            if self._simulated <= self._refilled:
                continue
            is_idle = phase == Phase.IDLE
            self._busy_worlds = int((~is_idle).sum())
            if is_idle.any():
                self.lead, self._has_idle = self.max_lead, True

    def _may_begin(self) -> bool:
        """Whether physics may begin another tick: a world is busy, and the renderer is at most `lead` ticks behind."""
        return self._busy_worlds > 0 and self._enqueued < self._taken + self.lead

    @contextlib.contextmanager
    def _physics_scope(self) -> Iterator[None]:
        """Context manager: physics' stream is the current stream, and its work is profiled."""
        with wp.ScopedStream(self.stream, sync_enter=False), scope("simulate", self.device):
            yield

    def _enqueue_part(self) -> None:
        """Enqueue the next part of a tick; after the last part, also the copy of its record into the queue."""
        if self._parts is None and self._has_idle:
            self._refill(self._more(False))
        self._parts = self._parts or self.simulation.tick_parts()
        if next(self._parts, ENDED) is ENDED:
            self.queue.put(self._enqueued)
            self._parts = None
            self._enqueued += 1
        if self.stream is not None:
            event = self._spare.pop() if self._spare else wp.Event(self.device)
            self._running.append(self.stream.record_event(event))

    def refill(self) -> bool:
        """Whether worlds that are all idle in the tick last taken have further episodes to run: those of `more`, which may wait here."""
        if self._taken > self._refilled:
            with self._physics_scope():
                while self._parts is not None:
                    self._enqueue_part()
                self._refill(self._more(True))
        return self._taken <= self._refilled

    def _refill(self, episodes: Sequence[int]) -> None:
        """Have idle worlds run these episodes from the next tick to be enqueued on; there are none left of the earlier ones."""
        if len(episodes):
            self.simulation.restart(episodes)
            self._refilled, self._has_idle, self._busy_worlds = self._enqueued, False, self.simulation.layout.worlds
            self.lead = min(1, self.max_lead)


MAX_LEAD = 1024
"""Maximum number of ticks by which physics may be ahead of the renderer. With 256, physics limits the end of a bake of 150 episodes."""
QUEUE_BYTES, QUEUE_PART = 1 << 30, 64
"""Memory budget of the ring of records: the device's memory divided by QUEUE_PART, at most QUEUE_BYTES, exceeded only if two slots need
more. 1 GiB holds MAX_LEAD ticks of 180 worlds, or 30 ticks of 512 worlds whose steps are recorded."""


def queue_lead(tick_bytes: int, device: wp.Device) -> int:
    """Maximum lead of physics: as many ticks as the budget has room for beside the one being rendered, at least one, at most MAX_LEAD.

    0 on a CPU, where physics and renderer do not overlap. `tick_bytes`: size of a `TickRecord` [bytes]. `device`: device of the
    simulation."""
    if not device.is_cuda:
        return 0
    budget = min(QUEUE_BYTES, device.total_memory // QUEUE_PART)
    return max(1, min(MAX_LEAD, budget // tick_bytes - 1))


def record_bytes(record: TickRecord) -> int:
    """Size of the arrays of a tick record [bytes]."""
    parts = [record.snapshot, record.status, record.observation, record.plan]
    arrays = [getattr(part, item.name) for part in parts for item in fields(part)]
    if record.physics is not None:
        arrays += record_arrays(record.physics)
    return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays)


class TickQueue:
    """Ring buffer of tick records, indexed by tick number: physics pushes on its stream, the renderer reads and releases on its own.

    On a GPU, `put` makes the stream of physics wait for the event that `release` recorded on the stream of the renderer, so that no slot is
    overwritten while it is read.
    """

    @collection_paused()
    def __init__(self, record: TickRecord, slots: int) -> None:
        """Allocate the ring. `record`: of the simulation, overwritten each tick. `slots`: capacity [ticks], with that being rendered."""
        self.slots = slots
        self._device = device = record.snapshot.live.device
        self._source = [getattr(record.snapshot, item.name) for item in fields(Snapshot)]
        self._copies = allocate_slots(self._source, slots, device)
        self._snapshots = [Snapshot(*arrays) for arrays in self._copies]
        targets = allocate_slots(TickReader.reported(record), slots, wp.get_device("cpu"), pinned=device.is_cuda)
        self._readers = [TickReader(record, arrays) for arrays in targets]
        self._released = [wp.Event(device) for _ in range(slots)] if device.is_cuda else []

    def put(self, tick: int) -> None:
        """Copy the record of a tick into its slot, asynchronously on the current stream."""
        slot = tick % self.slots
        if self._released:
            self._device.stream.wait_event(self._released[slot])
        for target, source in zip(self._copies[slot], self._source, strict=True):
            wp.copy(target, source)
        self._readers[slot].start()

    def get(self, tick: int) -> tuple[TickReport, Snapshot]:
        """Wait until the copies of a tick are complete; returns its report and snapshot, valid until the slot is released."""
        slot = tick % self.slots
        return self._readers[slot].wait(), self._snapshots[slot]

    def phase(self, tick: int) -> np.ndarray | None:
        """Poll a tick that `put` has enqueued: phase of each world at its end (world) int32, or None while its copies are pending."""
        return self._readers[tick % self.slots].phase()

    def release(self, tick: int) -> None:
        """Release the slot of a tick once all work now enqueued on the current stream is complete; does not block."""
        if self._released:
            self._device.stream.record_event(self._released[tick % self.slots])


def allocate_slots(arrays: Sequence[wp.array], slots: int, device: wp.Device, pinned: bool = False) -> list[list[wp.array]]:
    """Allocate a ring buffer: zeroed arrays with the shapes and types of `arrays` for each slot, views of one allocation per array.
    `arrays`: templates. `slots`: number of slots. `device`: where to allocate. `pinned`: whether to pin memory of the host."""
    rings: list[Any] = allocate_rings(arrays, slots, device, pinned)
    rows = [array.shape[0] for array in arrays]
    return [[ring[slot * count : (slot + 1) * count] for ring, count in zip(rings, rows, strict=True)] for slot in range(slots)]


def allocate_rings(arrays: Sequence[wp.array], slots: int, device: wp.Device, pinned: bool = False) -> list[wp.array]:
    """The allocations of `allocate_slots`: each array has the rows of all slots."""
    return [allocate_like(array, slots * array.shape[0], device, pinned) for array in arrays]
