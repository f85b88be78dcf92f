"""Spatial partitioning of a GPU with CUDA green contexts: streams restricted to disjoint sets of multiprocessors (SMs)."""

import ctypes
from functools import cache

import warp as wp

from synpick_warp.errors import DeviceError

_SM_RESOURCE = 1
"""CU_DEV_RESOURCE_TYPE_SM"""
_DEFAULT_STREAM = 1
"""CU_GREEN_CTX_DEFAULT_STREAM, required by cuGreenCtxCreate."""
_NON_BLOCKING = 1
"""CU_STREAM_NON_BLOCKING"""


class _Resource(ctypes.Structure):
    """CUdevResource. It has 152 bytes in CUDA 13, and is larger here, since newer drivers may write more."""

    _fields_ = (("type", ctypes.c_uint), ("padding", ctypes.c_ubyte * 92), ("sm_count", ctypes.c_uint), ("more", ctypes.c_ubyte * 412))


class SmPartition:
    """Split of a GPU's SMs into a main and a reserved set, with a green context for each.

    Kernels on its streams run on one of the two sets; kernels on other streams may use every SM. Green contexts and streams live as long as
    the process. Streams need a driver of CUDA 12.5 or newer.
    """

    def __init__(self, device: wp.Device, reserved: int) -> None:
        """Split the SMs of a GPU. `reserved`: number of reserved SMs; CUDA rounds up, with compute capability 9 to a multiple of 8. Raises
        DeviceError: the driver is missing or too old, or the device has too few SMs."""
        self.device = device
        self._driver = _load_driver()
        ordinal, groups = ctypes.c_int(), ctypes.c_uint(1)
        whole, kept, main = _Resource(), _Resource(), _Resource()
        to = ctypes.byref
        self._call("cuDeviceGet", to(ordinal), device.ordinal)
        self._call("cuDeviceGetDevResource", ordinal, to(whole), _SM_RESOURCE)
        self._call("cuDevSmResourceSplitByCount", to(kept), to(groups), to(whole), to(main), 0, reserved)
        self._main, self._reserved = self._make_context(ordinal, main), self._make_context(ordinal, kept)
        self.size, self.reserved = main.sm_count, kept.sm_count
        """Numbers of main and of reserved SMs."""

    def make_stream(self, on_reserved: bool = False, priority: int = 0) -> wp.Stream:
        """Create a stream on one of the two sets of SMs.

        Args:
            on_reserved: Whether to use the reserved SMs instead of the main ones.
            priority: CUDA stream priority; lower values have higher priority.

        Raises DeviceError: the driver is too old, or a CUDA call failed."""
        stream = ctypes.c_void_p()
        context = self._reserved if on_reserved else self._main
        self._call("cuGreenCtxStreamCreate", ctypes.byref(stream), context, _NON_BLOCKING, priority)
        return wp.Stream(self.device, cuda_stream=stream.value)

    def _make_context(self, ordinal: ctypes.c_int, resource: _Resource) -> ctypes.c_void_p:
        """Create the green context of a set of SMs."""
        description, context = ctypes.c_void_p(), ctypes.c_void_p()
        self._call("cuDevResourceGenerateDesc", ctypes.byref(description), ctypes.byref(resource), 1)
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


def count_reserved(device: wp.Device, fraction: float) -> int:
    """Convert a fraction of a GPU's SMs to a number of SMs, at least one."""
    return max(1, round(fraction * device.sm_count))


@cache
def _load_driver() -> ctypes.CDLL:
    """Load the CUDA driver's library, which Warp has loaded already."""
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise DeviceError("the NVIDIA driver's library libcuda.so.1 was not found") from error
