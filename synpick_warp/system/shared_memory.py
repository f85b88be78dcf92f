"""Anonymous shared memory (memfd) and the arrays in it: nothing leaks however the processes end."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

_ALIGNMENT = 64
"""Arrays start at a multiple of a cache line [B]."""


@dataclass(frozen=True)
class SharedArray:
    """Descriptor of an array in shared memory."""

    offset: int
    """First byte [B]."""
    shape: tuple[int, ...]
    dtype: str

    def map(self, memory: mmap.mmap) -> np.ndarray:
        """View of the array, without a copy; the memory stays mapped as long as the view."""
        return np.ndarray(self.shape, np.dtype(self.dtype), memory, self.offset)


def shared_bytes(sizes: Iterable[int]) -> int:
    """Shared memory that arrays of these sizes take, with alignment [B]."""
    return sum(-(-size // _ALIGNMENT) * _ALIGNMENT for size in sizes)


def allocate_shared_memory(size: int) -> tuple[int, mmap.mmap]:
    """Allocate anonymous shared memory (memfd): file handle and mapping. Unlike /dev/shm, containers do not limit its size.

    The caller closes the handle when it has been passed on; the mapping stays valid.

    Raises:
        OSError: Memory or descriptors are used up.
    """
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
