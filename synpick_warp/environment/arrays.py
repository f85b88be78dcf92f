"""Arrays of the caller's library: actions in, observations and results out."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.environment.settings import NUMPY, TORCH
from synpick_warp.errors import ActionError

VECTORS = (wp.vec3, wp.vec3ub)


def to_host(values: Any) -> np.ndarray:
    """Copy actions of NumPy, PyTorch, Warp or lists to the host; raises ActionError if they are none."""
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


class Exporter:
    """Hands arrays to a library, in memory of their own: a later step does not change them."""

    def __init__(self, backend: str, device: wp.Device) -> None:
        self.backend, self.device = backend, device

    def from_device(self, array: wp.array, count: int) -> Any:
        """The first `count` rows of an array on the device; vectors become a last dimension."""
        if self.backend == NUMPY:
            return array[:count].numpy().copy()
        rows: Any = array[:count]
        return self._export(wp.clone(_flatten_vectors(rows) if array.dtype in VECTORS else rows))

    def from_host(self, values: np.ndarray) -> Any:
        """An array of the host."""
        if self.backend == NUMPY:
            return values
        return self._export(wp.array(np.ascontiguousarray(values), dtype=_scalar(values.dtype), device=self.device))

    def _export(self, array: wp.array) -> Any:
        """An array of the device that nothing else refers to. On a GPU, it is complete on all streams."""
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
    """Warp's type of a NumPy type."""
    return wp.bool if dtype.kind == "b" else wp.dtype_from_numpy(dtype)
