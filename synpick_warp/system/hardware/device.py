"""Device selection, and start of Warp without its banner."""

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system.hardware.caches import usable_kernel_cache
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

    A kernel cache that cannot be written is replaced by a temporary one, with a note. Raises CacheError: there is no room for a temporary
    one."""
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
