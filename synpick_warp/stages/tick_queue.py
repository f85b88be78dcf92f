"""Queue of simulated ticks between physics and renderer: a ring buffer of snapshots on the device and of reports in pinned host memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.stages.arrays import allocate_like
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.sim.simulate import TickRecord
from synpick_warp.stages.sim.step_log import record_arrays
from synpick_warp.stages.stream import TickReader, TickReport
from synpick_warp.system.interpreter import collection_paused

MAX_LEAD = 1024
"""Maximum number of ticks by which physics may be ahead of the renderer. With 256, physics limits the last quarter of a bake of
150 episodes."""
QUEUE_BYTES, QUEUE_PART = 1 << 30, 64
"""Memory budget of the ring of records: the device's memory divided by QUEUE_PART, at most QUEUE_BYTES, exceeded only if two slots need
more. 1 GiB holds MAX_LEAD ticks of 180 worlds, or 30 ticks of 512 worlds whose steps are recorded."""


def queue_lead(tick_bytes: int, device: wp.Device) -> int:
    """Maximum lead of physics: as many ticks as the budget has room for beside the one being rendered, at least one, at most MAX_LEAD.

    0 on a CPU, where physics and renderer do not overlap.

    Args:
        tick_bytes: Size of a `TickRecord` [bytes].
        device: Device of the simulation.
    """
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
        """Allocate the ring.

        Args:
            record: Record of the simulation, which each tick overwrites.
            slots: Capacity [ticks], including the tick being rendered.
        """
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

    Args:
        arrays: Templates.
        slots: Number of slots.
        device: Where to allocate.
        pinned: Whether to pin memory of the host.
    """
    rings: list[Any] = allocate_rings(arrays, slots, device, pinned)
    rows = [array.shape[0] for array in arrays]
    return [[ring[slot * count : (slot + 1) * count] for ring, count in zip(rings, rows, strict=True)] for slot in range(slots)]


def allocate_rings(arrays: Sequence[wp.array], slots: int, device: wp.Device, pinned: bool = False) -> list[wp.array]:
    """The allocations of `allocate_slots`: each array has the rows of all slots."""
    return [allocate_like(array, slots * array.shape[0], device, pinned) for array in arrays]
