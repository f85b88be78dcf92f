"""Conversion of arrays: actions of NumPy, PyTorch or Warp to the host, observations and results to the caller's library."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.environment.settings import NUMPY, TORCH
from synpick_warp.errors import ActionError

VECTORS = (wp.vec3, wp.vec3ub)


def to_host(values: Any) -> np.ndarray:
    """Copy actions (array of NumPy, PyTorch or Warp, or nested lists) to the host; raises ActionError if they are not numbers."""
    if isinstance(values, wp.array):
        return values.numpy()
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ActionError(f"actions have no common shape: {error}") from error
    if array.dtype.kind not in "biuf":
        raise ActionError(f"actions are {array.dtype}; allowed: numbers")
    return array


class ArrayExporter:
    """Converter of arrays to the caller's library (`backend`); results own their memory, so that a later step does not change them."""

    def __init__(self, backend: str, device: wp.Device) -> None:
        self.backend, self.device = backend, device

    def from_device(self, array: wp.array, count: int) -> Any:
        """Copy the first `count` rows of a device array; components of vectors become the last dimension."""
        if self.backend == NUMPY:
            return array[:count].numpy().copy()
        rows: Any = array[:count]
        return self._export(wp.clone(_flatten_vectors(rows) if array.dtype in VECTORS else rows))

    def from_host(self, values: np.ndarray) -> Any:
        """Convert an array of the host: to the device, or for backend "numpy" as it is."""
        if self.backend == NUMPY:
            return values
        return self._export(wp.array(np.ascontiguousarray(values), dtype=_scalar(values.dtype), device=self.device))

    def _export(self, array: wp.array) -> Any:
        """Convert a device array that nothing else refers to; for PyTorch on a GPU, its content is complete on all streams."""
        if self.backend == TORCH:
            if self.device.is_cuda:
                wp.synchronize_device(self.device)
            return wp.to_torch(array)
        return array


def _flatten_vectors(array: wp.array) -> wp.array:
    """View of a contiguous array of vectors as scalars, with their components as the last dimension; valid as long as the array."""
    scalar, length = array.dtype._wp_scalar_type_, array.dtype._length_
    return wp.array(ptr=array.ptr, dtype=scalar, shape=(*array.shape, length), device=array.device, copy=False)


def _scalar(dtype: np.dtype) -> Any:
    """Warp scalar type of a NumPy type."""
    return wp.bool if dtype.kind == "b" else wp.dtype_from_numpy(dtype)
