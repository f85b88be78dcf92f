"""DLPack exchange of device arrays without copies, with the order of producer and consumers kept by CUDA events.

A slot is a set of buffers that is rendered into again and again. Its `Gate` keeps two orders on a GPU, neither of which blocks the host:
a consumer's stream reads after the rendering of its batch (and not after whatever else was queued since), and the next rendering into the
slot begins after everything that consumers' streams had been given until the batch expired.

On the CPU both hold by themselves for libraries that compute when they are called, such as PyTorch and NumPy. JAX computes later, on a CPU,
too, and on streams of its own: its users must wait for their results before they request the next batch.
"""

from typing import Any

import numpy as np
import warp as wp

_LEGACY_STREAM = 1
"""DLPack's number of CUDA's legacy default stream, which `stream=None` means."""
_NO_ORDER = -1
"""DLPack's stream argument for "do not synchronize"."""
_EXPIRED = "this batch has expired: its buffers are rendered into again; clone what you keep before you ask for the next batch"


class ConsumerStream(wp.Stream):
    """Non-owning wrapper of another library's CUDA stream. It is not registered with Warp, whose registry has one entry a handle, which may
    belong to a stream object of the consumer."""

    def __init__(self, device: wp.Device, handle: int) -> None:
        self.device, self.cuda_stream = device, handle

    def __del__(self) -> None:
        """Nothing to release."""


class Gate:
    """Order of the renderer's and the consumers' work on the buffers of a slot; see the module.

    Attributes:
        turn: Number of batches that the slot has held and that have expired.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device, self.turn = device, 0
        self._ready = wp.Event(device) if device.is_cuda else None
        self._consumers: dict[int, tuple[wp.Stream, wp.Event]] = {}
        """By the stream's handle: the stream, and the event behind its work on this batch."""

    def wait_for_consumers(self) -> None:
        """Make the current stream wait for the consumers of the previous batch, and forget these."""
        for _, event in self._consumers.values():
            self.device.stream.wait_event(event)
        self._consumers.clear()

    def mark_ready(self) -> None:
        """Record the event "rendered" of this batch on the current stream."""
        if self._ready is not None:
            self.device.stream.record_event(self._ready)

    def admit(self, handle: int | None) -> None:
        """Let a consumer's stream wait for the rendering of this batch. `handle`: the stream by DLPack's convention; it must live until the
        batch expires."""
        if self._ready is None or handle == _NO_ORDER:
            return
        handle = _LEGACY_STREAM if handle is None else handle
        if handle not in self._consumers:
            self._consumers[handle] = (ConsumerStream(self.device, handle), wp.Event(self.device))
        with wp.ScopedDevice(self.device):
            self._consumers[handle][0].wait_event(self._ready)

    def admit_current(self) -> None:
        """Let the device's current stream, which may be that of a consumer that uses Warp, wait for the rendering of this batch."""
        if self._ready is not None:
            self.admit(self.device.stream.cuda_stream)

    def expire(self) -> None:
        """End the batch: its arrays refuse further use, and what the consumers' streams have queued so far is noted."""
        self.turn += 1
        if self._consumers:
            with wp.ScopedDevice(self.device):
                for stream, event in self._consumers.values():
                    stream.record_event(event)


class DeviceArray:
    """Array in a batch's buffers, on the device that renders: torch, JAX, CuPy, Warp and NumPy read it through DLPack, without a copy.

        color = torch.from_dlpack(batch.color)          # likewise jax.dlpack, cupy, warp; numpy on the CPU

    Attributes:
        shape: Extents, components of vectors and matrices last.
        dtype: Type of the elements.
        device: Where the array lies, "cpu" or "cuda:N".
    """

    def __init__(self, array: wp.array, gate: Gate) -> None:
        self._array, self._gate, self._turn = array, gate, gate.turn
        scalar, inner = getattr(array.dtype, "_wp_scalar_type_", array.dtype), getattr(array.dtype, "_shape_", ())
        self.shape = (*array.shape, *inner)
        self.dtype = np.dtype(wp.dtype_to_numpy(scalar))
        self.device = array.device.alias

    def __dlpack_device__(self) -> tuple[int, int]:
        """Type and index of the device by DLPack's numbers."""
        kind, index = self._array.__dlpack_device__()
        return int(kind), int(index)

    def __dlpack__(
        self,
        stream: int | None = None,
        *,
        max_version: tuple[int, int] | None = None,
        dl_device: tuple[int, int] | None = None,
        copy: bool | None = None,
    ) -> Any:
        """Export the array; called by `from_dlpack` of the consumer's library.

        Args:
            stream: The consumer's stream, which will wait for the rendering; -1: it does not.
            max_version: Not used: the capsule is of the first version, which all libraries read.
            dl_device: Device that the consumer asks for.
            copy: Whether the consumer asks for a copy, which stays valid when the batch has expired.

        Raises BufferError: the batch has expired, or the consumer asks for another device."""
        if dl_device is not None and tuple(dl_device) != self.__dlpack_device__():
            raise BufferError(f"this array lies on {self.device}; import it there, then move it")
        array = self._valid()
        if copy:
            self._gate.admit_current()
            return wp.clone(array).__dlpack__(stream=stream)
        self._gate.admit(stream)
        return array.__dlpack__(stream=_NO_ORDER)

    def numpy(self) -> np.ndarray:
        """The array on the host: on the CPU the buffer itself, on a GPU a copy, for which the host waits. Raises BufferError: the batch has
        expired."""
        array = self._valid()
        self._gate.admit_current()
        return array.numpy()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """For `numpy.asarray`; as `numpy()`."""
        return np.array(self.numpy(), dtype=dtype, copy=copy)

    def check(self) -> None:
        """Raise a BufferError if the batch has expired."""
        self._valid()

    def _valid(self) -> wp.array:
        """The array, if the batch has not expired; else raises BufferError."""
        if self._turn != self._gate.turn:
            raise BufferError(_EXPIRED)
        return self._array

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"DeviceArray({self.dtype}, {self.shape}, {self.device})"
