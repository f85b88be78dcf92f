"""CUDA streams of the renderer and of the encoders, on all multiprocessors (SMs) of a GPU or on a subset that leaves SMs to physics."""

from __future__ import annotations

import contextlib
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system.green_contexts import SmPartition

StreamPair = tuple[wp.Stream | None, wp.Stream | None]
"""Render stream (None: the current stream of the device), and stream for encoding and copies to the host. Both are None on a CPU."""


class RenderStreams:
    """Pair of CUDA streams, for rendering and for encoding, whose SM partition can be switched between batches.

    As a context manager it synchronizes the current pair on exit, so that arrays in use can be freed. Warp's memory pool does not order
    frees after work on these streams: do not allocate on them.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.reserved = 0.0
        """Fraction of the SMs requested to be left free; it has no effect if the GPU cannot be partitioned."""
        self.render: wp.Stream | None = None
        self.copy = wp.Stream(device) if device.is_cuda else None
        self._pairs: dict[float, StreamPair] = {0.0: (self.render, self.copy)}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with contextlib.suppress(RuntimeError):  # A failed device; the next call to it raises the error.
            for stream in (self.render, self.copy):
                if stream is not None:
                    wp.synchronize_stream(stream)

    def confine(self, reserved: float) -> None:
        """Switch to the pair of streams that leaves a fraction `reserved` of the SMs free; 0: to the pair on the whole GPU.

        Call it between batches. It does nothing on a CPU, or if the driver does not support partitions.
        """
        before = self.copy
        if before is None or reserved == self.reserved:
            return
        if reserved not in self._pairs:
            self._pairs[reserved] = self._make_pair(reserved)
        self.reserved = reserved
        self.render, self.copy = self._pairs[reserved]
        if self.copy is not None and self.copy is not before:
            self.copy.wait_stream(before)  # Batches share the encoders' scratch arrays.

    def _make_pair(self, reserved: float) -> StreamPair:
        """Create a pair of streams on a partition; if that is not supported, return the pair on the whole GPU."""
        try:
            partition = SmPartition(self.device, max(1, round(reserved * self.device.sm_count)))
            return partition.make_stream(), partition.make_stream()
        except DeviceError:
            return self._pairs[0.0]
