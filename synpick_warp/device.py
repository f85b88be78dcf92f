"""Device selection, and start of Warp without its banner."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Iterator

import warp as wp

from synpick_warp.errors import DeviceError

_CUDA = re.compile(r"cuda:(\d+)")
_NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"
"""Warp's native code prints this regardless of the log level; a machine without a GPU is not a fault."""


def pick_device(name: str) -> wp.Device:
    """Select a device by name; starts Warp on the first call.

    Args:
        name: "cpu", "cuda:N", or "auto": the first GPU if there is one, else the CPU.

    Raises:
        DeviceError: The name has another form, or there is no such GPU.
    """
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


def start_warp() -> None:
    """Initialise Warp without its banner and its messages per loaded kernel; warnings are kept."""
    wp.config.log_level = wp.LOG_WARNING
    with _without_driver_warning():
        wp.init()


@contextlib.contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Redirect stderr at file-descriptor level, and then print everything but the line about the missing driver."""
    if sys.stderr is None:
        yield
        return
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            held.seek(0)
            for line in held.read().decode(errors="replace").splitlines():
                if _NO_DRIVER not in line:
                    print(line, file=sys.stderr)
