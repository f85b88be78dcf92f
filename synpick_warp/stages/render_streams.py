"""CUDA streams of the renderer, of the encoders and of physics, on all multiprocessors (SMs) of a GPU or on disjoint subsets of them."""

from __future__ import annotations

import contextlib
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system.green_contexts import SmPartition, count_reserved

HIGH_PRIORITY = -1
"""CUDA stream priority of physics: its 13,000 short kernels per tick depend on one another, and should not also wait for the renderer's."""

Streams = tuple[wp.Stream | None, wp.Stream | None, wp.Stream | None]
"""Render stream (None: the current stream of the device), stream for encoding and copies to the host, and stream on the SMs that both leave
free (None: there are none). All are None on a CPU."""


class RenderStreams:
    """CUDA streams for rendering and for encoding, whose SM partition can be switched between batches, and one on the SMs left to physics.

    As a context manager it synchronizes the first two on exit, so that arrays in use can be freed. Warp's memory pool does not order
    frees after work on these streams: do not allocate on them.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.reserved = 0.0
        """Fraction of the SMs requested to be left free; it has no effect if the GPU cannot be partitioned."""
        self.render: wp.Stream | None = None
        self.copy = wp.Stream(device) if device.is_cuda else None
        self.physics: wp.Stream | None = None
        """Stream on the SMs that are left free; None: there are none."""
        self._partitions: dict[float, Streams] = {0.0: (self.render, self.copy, self.physics)}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with contextlib.suppress(RuntimeError):  # A failed device; the next call to it raises the error.
            for stream in (self.render, self.copy):
                if stream is not None:
                    wp.synchronize_stream(stream)

    def confine(self, reserved: float) -> None:
        """Switch to the streams that leave a fraction `reserved` of the SMs free; 0: to those on the whole GPU.

        Call it between batches. It does nothing on a CPU, or if the driver does not support partitions.
        """
        before = self.copy
        if before is None or reserved == self.reserved:
            return
        if reserved not in self._partitions:
            self._partitions[reserved] = self._make_streams(reserved)
        self.reserved = reserved
        self.render, self.copy, self.physics = self._partitions[reserved]
        if self.copy is not None and self.copy is not before:
            self.copy.wait_stream(before)  # Batches share the encoders' scratch arrays.

    def _make_streams(self, reserved: float) -> Streams:
        """Create the streams of a partition; if that is not supported, return those on the whole GPU."""
        try:
            partition = SmPartition(self.device, count_reserved(self.device, reserved))
            return partition.make_stream(), partition.make_stream(), partition.make_stream(reserved=True, priority=HIGH_PRIORITY)
        except DeviceError:
            return self._partitions[0.0]
