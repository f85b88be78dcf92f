"""Partition of a GPU's multiprocessors by CUDA green contexts: streams whose kernels run on some of them, or on the others."""

from __future__ import annotations

import ctypes
from functools import cache

import warp as wp

from synpick_warp.errors import DeviceError

_SM_RESOURCE = 1
"""CU_DEV_RESOURCE_TYPE_SM"""
_DEFAULT_STREAM = 1
"""CU_GREEN_CTX_DEFAULT_STREAM, which cuGreenCtxCreate demands."""
_NON_BLOCKING = 1
"""CU_STREAM_NON_BLOCKING"""


class _Resource(ctypes.Structure):
    """CUdevResource. CUDA 13 has 152 bytes; here are more, since later drivers may write more."""

    _fields_ = (("type", ctypes.c_uint), ("padding", ctypes.c_ubyte * 92), ("sm_count", ctypes.c_uint), ("more", ctypes.c_ubyte * 412))


class SmPartition:
    """CUDA green contexts on a subset of a GPU's streaming multiprocessors (SMs) and on the others, which are reserved.

    Kernels on its streams run on one of the two subsets; kernels on other streams may use every multiprocessor.
    Green contexts and streams live as long as the process.
    """

    def __init__(self, device: wp.Device, reserved: int) -> None:
        """Split the multiprocessors of a GPU.

        Args:
            device: A GPU.
            reserved: Multiprocessors outside the partition; CUDA rounds up, with compute capability 9 to a multiple of 8.

        Raises:
            DeviceError: The driver is missing or has no green contexts (before CUDA 12.4), or the device has too few multiprocessors.
        """
        self.device = device
        self._driver = _load_driver()
        ordinal, groups = ctypes.c_int(), ctypes.c_uint(1)
        whole, outside, inside = _Resource(), _Resource(), _Resource()
        to = ctypes.byref
        self._call("cuDeviceGet", to(ordinal), device.ordinal)
        self._call("cuDeviceGetDevResource", ordinal, to(whole), _SM_RESOURCE)
        self._call("cuDevSmResourceSplitByCount", to(outside), to(groups), to(whole), to(inside), 0, reserved)
        self._inside, self._outside = self._make_context(ordinal, inside), self._make_context(ordinal, outside)
        self.size, self.reserved = inside.sm_count, outside.sm_count
        """Multiprocessors inside and outside the partition."""

    def make_stream(self, reserved: bool = False, priority: int = 0) -> wp.Stream:
        """Create a stream whose kernels run inside the partition.

        Args:
            reserved: Outside instead, on the reserved multiprocessors.
            priority: CUDA stream priority; lower numbers first.

        Raises:
            DeviceError: The driver is older than CUDA 12.5, or a CUDA error.
        """
        stream = ctypes.c_void_p()
        context = self._outside if reserved else self._inside
        self._call("cuGreenCtxStreamCreate", ctypes.byref(stream), context, _NON_BLOCKING, priority)
        return wp.Stream(self.device, cuda_stream=stream.value)

    def _make_context(self, ordinal: ctypes.c_int, multiprocessors: _Resource) -> ctypes.c_void_p:
        """Create the green context of a set of multiprocessors."""
        description, context = ctypes.c_void_p(), ctypes.c_void_p()
        self._call("cuDevResourceGenerateDesc", ctypes.byref(description), ctypes.byref(multiprocessors), 1)
        self._call("cuGreenCtxCreate", ctypes.byref(context), description, ordinal, _DEFAULT_STREAM)
        return context

    def _call(self, name: str, *arguments: object) -> None:
        """Call a function of the driver; a result other than 0 raises a DeviceError."""
        function = getattr(self._driver, name, None)
        if function is None:
            raise DeviceError(f"{self.device.alias}: the driver has no {name}: green contexts with streams need CUDA 12.5")
        result = function(*arguments)
        if result != 0:
            raise DeviceError(f"{self.device.alias}: {name} failed with CUDA error {result}")


def count_reserved(device: wp.Device, share: float) -> int:
    """Number of multiprocessors that a share of those of a GPU stands for, at least one."""
    return max(1, round(share * device.sm_count))


@cache
def _load_driver() -> ctypes.CDLL:
    """The driver's library, which Warp has loaded before."""
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise DeviceError("the NVIDIA driver's library libcuda.so.1 was not found") from error
