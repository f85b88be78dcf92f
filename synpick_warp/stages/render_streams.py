"""CUDA streams of the renderer, the encoders and the solver: on all multiprocessors (SMs) of a GPU, or on disjoint sets of them."""

import contextlib
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system.hardware.device import HIGH_PRIORITY, SmPartition, count_reserved

Streams = tuple[wp.Stream | None, wp.Stream | None, wp.Stream | None]
"""Streams (render, copy, solver), all None on a CPU. Render: None for the device's current stream. Copy: for encoding and for copies to the
host. Solver: on the reserved SMs, None if none are reserved."""


class RenderStreams:
    """CUDA streams for rendering, for encoding and for the solver of physics, which can be restricted to disjoint sets of SMs and back.

    Physics runs on a stream of its own on all SMs (see `TickLoop`). While SMs are reserved, its solver runs on them alone, and renderer and
    encoders run on the others. Exiting the context waits for the render and copy streams, so that arrays in use can be freed. Do not
    allocate on these streams: Warp's memory pool may reuse memory before their work is complete.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.reserved = 0.0
        """Fraction of the SMs that are to be reserved; it has no effect if the GPU cannot be partitioned."""
        self.render: wp.Stream | None = None
        self.copy = wp.Stream(device) if device.is_cuda else None
        self.solver: wp.Stream | None = None
        self._partitions: dict[float, Streams] = {0.0: (self.render, self.copy, self.solver)}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with contextlib.suppress(RuntimeError):  # The device failed; the next call to it raises the error.
            for stream in (self.render, self.copy):
                if stream is not None:
                    wp.synchronize_stream(stream)

    def confine(self, reserved: float) -> None:
        """Switch to the streams of a partition with a fraction `reserved` of the SMs for the solver; 0: to those on the whole GPU.

        Call it between batches. It does nothing on a CPU, or if the driver does not support partitions.
        """
        before = self.copy
        if before is None or reserved == self.reserved:
            return
        if reserved not in self._partitions:
            self._partitions[reserved] = self._make_streams(reserved)
        self.reserved = reserved
        self.render, self.copy, self.solver = self._partitions[reserved]
        if self.copy is not None and self.copy is not before:
            self.copy.wait_stream(before)  # Batches share the encoders' scratch arrays.

    def _make_streams(self, reserved: float) -> Streams:
        """Create the streams of a partition; if that is not supported, return those on the whole GPU."""
        try:
            partition = SmPartition(self.device, count_reserved(self.device, reserved))
            return partition.make_stream(), partition.make_stream(), partition.make_stream(on_reserved=True, priority=HIGH_PRIORITY)
        except DeviceError:
            return self._partitions[0.0]
