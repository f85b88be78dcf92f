"""Device selection, start of Warp without its banner, and green contexts: streams restricted to disjoint sets of multiprocessors (SMs)."""

import contextlib
import ctypes
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system.hardware.kernels import usable_kernel_cache
from synpick_warp.system.interpreter import STANDARD_ERROR

_CONNECTIONS = ("CUDA_DEVICE_MAX_CONNECTIONS", "32")
"""Hardware queues that CUDA maps streams to; its default is 8. Captured graphs of physics spread over several streams. Where they share
queues with the renderer's stream, neither runs beside the other."""
_CUDA = re.compile(r"cuda:([0-9]{1,9})")
ALL = "all"
"""Stands for every GPU, or the CPU if there is none."""
_DEVICES = "allowed: all, or GPUs such as cuda:0,cuda:1, or cpu once per process"
_NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"
"""Warp's native code prints this regardless of the log level; a machine without a GPU is not a fault."""


def pick_device(name: str) -> wp.Device:
    """Select a device by name; starts Warp on the first call. `name`: "cpu", "cuda:N", or "auto": the first GPU if there is one, else the
    CPU. Raises DeviceError: the name has another form, or there is no such GPU."""
    start_warp()
    count = wp.get_cuda_device_count()
    if name == "auto":
        name = "cuda:0" if count else "cpu"
    if name == "cpu":
        return wp.get_device(name)
    match = _CUDA.fullmatch(name)
    if match is None:
        raise DeviceError(f'bake.device is "{name}"; allowed: cpu, cuda:N such as cuda:0, or auto')
    if int(match[1]) >= count:
        present = "no CUDA device" if count == 0 else f"only cuda:0 to cuda:{count - 1}" if count > 1 else "only cuda:0"
        raise DeviceError(f"{name} was requested, but Warp finds {present} here; use --device {'cuda:0' if count else 'cpu'}")
    return wp.get_device(f"cuda:{int(match[1])}")


def pick_devices(names: Sequence[str]) -> tuple[str, ...]:
    """Select the devices of a bake with one process each; returns their names. Starts Warp, but touches no device. `names`: different GPUs,
    or "cpu" once per process, since a process simulates on one core. `ALL` alone: every GPU, or the CPU if there is none. Raises
    DeviceError: there is no such device, a GPU is named twice, or the CPU beside a GPU."""
    if not names:
        raise DeviceError(f"--devices names none; {_DEVICES}")
    if list(names) == [ALL]:
        start_warp()
        return tuple(f"cuda:{index}" for index in range(wp.get_cuda_device_count())) or ("cpu",)
    for name in names:
        if name in (ALL, "auto"):
            raise DeviceError(f"--devices names {name} beside others; {_DEVICES}" if len(names) > 1 else f"--devices is {name}; {_DEVICES}")
        if name != "cpu" and not _CUDA.fullmatch(name):
            raise DeviceError(f'--devices names "{name}"; {_DEVICES}')
    picked = [pick_device(name) for name in names]
    gpus = [device.alias for device in picked if device.is_cuda]
    if gpus and len(gpus) < len(picked):
        raise DeviceError(f"--devices names cpu beside {gpus[0]}, which computes other last bits; name either GPUs or cpu")
    twice = next((name for name in gpus if gpus.count(name) > 1), None)
    if twice:
        raise DeviceError(f"--devices names {twice} twice; name each GPU once: its one process simulates bake.worlds totes")
    return tuple(device.alias for device in picked)


def describe_kinds(names: Sequence[str]) -> str:
    """Say that devices are of different kinds, if they are: "cuda:0 is NVIDIA H100, cuda:1 NVIDIA H200"; empty: all are of one kind."""
    kinds = [wp.get_device(name).name for name in names]
    if len(set(kinds)) == 1:
        return ""
    return f"{names[0]} is {kinds[0]}, " + ", ".join(f"{name} {kind}" for name, kind in zip(names[1:], kinds[1:], strict=True))


@contextlib.contextmanager
def opening_context(device: wp.Device | None) -> Iterator[None]:
    """Context manager that creates the CUDA context of a GPU in a thread, which takes 0.9 s without the interpreter's lock. Faults are left
    to the first use. The CPU has none; None: no device."""
    with ThreadPoolExecutor(1) as pool:
        if device is not None:
            pool.submit(getattr, device, "context")
        yield


def start_warp() -> None:
    """Initialise Warp without its banner and its messages per loaded kernel; warnings are kept.

    A kernel cache that cannot be written is replaced by a temporary one, with a note. Raises CacheError: there is no room for one."""
    os.environ.setdefault(*_CONNECTIONS)  # CUDA reads it when it starts.
    wp.config.log_level = wp.LOG_WARNING
    wp.config.cuda_output = wp.config.cuda_output or "cubin"  # A new driver would compile PTX instead, one module after the other.
    if wp.config.kernel_cache_dir is None:  # Else the caller has chosen, or Warp runs already.
        temporary = usable_kernel_cache(wp.config.version)
        wp.config.kernel_cache_dir = None if temporary is None else str(temporary)
    with _without_driver_warning():
        wp.init()


@contextlib.contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Redirect stderr at file-descriptor level, and then print everything but the line about the missing driver."""
    if sys.stderr is None:
        yield
        return
    sys.stderr.flush()
    with contextlib.ExitStack() as stack:
        try:
            kept = os.dup(STANDARD_ERROR)
            stack.callback(os.close, kept)
            held = stack.enter_context(tempfile.TemporaryFile())
        except OSError:  # The descriptor is closed, or no temporary folder can be written.
            yield
            return
        os.dup2(held.fileno(), STANDARD_ERROR)
        try:
            yield
        finally:
            os.dup2(kept, STANDARD_ERROR)
            held.seek(0)
            for line in held.read().decode(errors="replace").splitlines():
                if _NO_DRIVER not in line:
                    print(line, file=sys.stderr)


HIGH_PRIORITY = -1
"""CUDA stream priority of physics: its 6,600 short kernels per tick depend on one another, and should not also wait for the renderer's."""
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
        """Create a stream on one of the two sets of SMs. `on_reserved`: whether to use the reserved SMs. `priority`: CUDA stream priority;
        lower values have higher priority. Raises DeviceError: the driver is too old, or a CUDA call failed."""
        stream = ctypes.c_void_p()
        context = self._reserved if on_reserved else self._main
        self._call("cuGreenCtxStreamCreate", ctypes.byref(stream), context, _NON_BLOCKING, priority)
        return wp.Stream(self.device, cuda_stream=stream.value)

    def _make_context(self, ordinal: ctypes.c_int, resource: _Resource) -> ctypes.c_void_p:
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


def sibling_stream(stream: wp.Stream) -> wp.Stream:
    """Create a stream of high priority beside another one: on its SMs, if it belongs to an `SmPartition`, else on all."""
    context, sibling, driver = ctypes.c_void_p(), ctypes.c_void_p(), _load_driver()
    find = getattr(driver, "cuStreamGetGreenCtx", None)  # The driver has it if it has streams of green contexts.
    if find is None or find(ctypes.c_void_p(stream.cuda_stream), ctypes.byref(context)) != 0 or not context.value:
        return wp.Stream(stream.device, priority=HIGH_PRIORITY)
    result = driver.cuGreenCtxStreamCreate(ctypes.byref(sibling), context, _NON_BLOCKING, HIGH_PRIORITY)
    if result != 0:
        raise DeviceError(f"{stream.device.alias}: cuGreenCtxStreamCreate failed with CUDA error {result}")
    return wp.Stream(stream.device, cuda_stream=sibling.value)


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
