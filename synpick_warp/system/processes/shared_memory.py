"""Anonymous shared memory (memfd), the arrays in it, and slots for those of tasks: nothing leaks however the processes end."""

import contextlib
import mmap
import os
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from synpick_warp.system.hardware.cores import COPIES
from synpick_warp.system.interpreter import open_standard_descriptors

_ALIGNMENT = 64
"""Arrays start at a multiple of a cache line [B]."""


@dataclass(frozen=True)
class SharedArray:
    """Descriptor of an array in shared memory: offset [B], shape and type."""

    offset: int
    shape: tuple[int, ...]
    dtype: str

    def map(self, memory: mmap.mmap) -> np.ndarray:
        """View of the array, without a copy; the memory stays mapped as long as the view."""
        return np.ndarray(self.shape, np.dtype(self.dtype), memory, self.offset)


def shared_bytes(sizes: Iterable[int]) -> int:
    """Shared memory that arrays of these sizes take, with alignment [B]."""
    return sum(map(_align, sizes))


def _align(size: int) -> int:
    """Size rounded up to the alignment [B]."""
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def allocate_shared_memory(size: int) -> tuple[int, mmap.mmap]:
    """Allocate anonymous shared memory (memfd): file handle and mapping. Unlike /dev/shm, containers do not limit its size.

    The caller closes the handle when it has been passed on; the mapping stays valid. Raises OSError: memory or descriptors are used up."""
    open_standard_descriptors()
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("synpick-warp")
    else:
        with tempfile.TemporaryFile() as file:
            handle = os.dup(file.fileno())
    try:
        os.ftruncate(handle, size)
        return handle, mmap.mmap(handle, size)
    except OSError:
        os.close(handle)
        raise


class SharedSlots:
    """Slots of equal size in shared memory, each for the arrays of one task. The caller closes `handle` when it has been passed on."""

    def __init__(self, count: int, slot_bytes: int, copy_threads: int = 0) -> None:
        """`count`: number of slots. `slot_bytes`: maximum size of the arrays of one task, see `shared_bytes` [B]. `copy_threads`: threads
        that copy arrays; 0: `put` itself does. Raises OSError: memory or descriptors are used up."""
        self._slot_bytes = -(-max(slot_bytes, 1) // mmap.PAGESIZE) * mmap.PAGESIZE
        self.free = list(range(count))
        """Indices of the slots that no task uses."""
        self._threads = ThreadPoolExecutor(copy_threads, COPIES) if copy_threads else None
        self.handle, self._memory = allocate_shared_memory(count * self._slot_bytes)

    def put(self, arrays: Sequence[np.ndarray], slot: int) -> tuple[tuple[SharedArray, ...], Future[None] | None]:
        """Copy arrays into a slot; returns their places, and the copy in progress if a thread makes it."""
        first = offset = slot * self._slot_bytes
        places: list[SharedArray] = []
        for array in arrays:
            places.append(SharedArray(offset, array.shape, array.dtype.str))
            offset += _align(array.nbytes)
        if offset - first > self._slot_bytes:
            raise ValueError(f"images of {offset - first} bytes exceed the {self._slot_bytes} of a slot of this pool")
        targets = [place.map(self._memory) for place in places]
        if self._threads is None:
            _copy(targets, arrays)
            return tuple(places), None
        return tuple(places), self._threads.submit(_copy, targets, arrays)

    def close(self) -> None:
        """Give the memory back. Never raises."""
        if self._threads is not None:
            self._threads.shutdown()
        with contextlib.suppress(BufferError):
            self._memory.close()


def _copy(targets: Sequence[np.ndarray], arrays: Sequence[np.ndarray]) -> None:
    """Copy arrays into shared memory; NumPy releases the interpreter lock meanwhile."""
    for target, array in zip(targets, arrays, strict=True):
        np.copyto(target, array)
