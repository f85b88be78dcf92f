"""CUDA streams of renderer and encoders: on all multiprocessors of a GPU, or on a part of them, so that physics has the others."""

from __future__ import annotations

import contextlib
from types import TracebackType
from typing import Self

import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system.green_contexts import SmPartition

StreamPair = tuple[wp.Stream | None, wp.Stream | None]
"""Stream of rendering, None: the device's current stream; and stream of encoding and copying. On a CPU both are None."""


class RenderStreams:
    """CUDA streams of rendering and of encoding and copying, on a part of the GPU that can change between batches.

    A context manager: its exit synchronizes the current two streams, so that their arrays can be freed. Warp's memory pool does not wait
    for them, so that what runs on them must not allocate.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.reserved = 0.0
        """Requested fraction of the multiprocessors to leave free; without effect if the GPU cannot be divided."""
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
        """Choose where following batches are rendered and encoded: on all multiprocessors but a fraction `reserved`.

        Without effect on a CPU, and where the driver cannot divide the GPU.
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
        """Streams on a part of the GPU; those on the whole one if it cannot be divided."""
        try:
            partition = SmPartition(self.device, max(1, round(reserved * self.device.sm_count)))
            return partition.make_stream(), partition.make_stream()
        except DeviceError:
            return self._pairs[0.0]
