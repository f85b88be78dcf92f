"""State of the interpreter: descriptors of the standard streams, of which closed ones are opened on the null device, so that no other file
takes their numbers, and a pause of the garbage collector."""

import contextlib
import fcntl
import gc
import os
import sys
from collections.abc import Iterator

STANDARD_ERROR = 2
"""Descriptor of the standard error, the last of the three."""


def open_standard_descriptors() -> None:
    """Open those of the descriptors 0, 1 and 2 that are closed (`>&-` in a shell) on the null device.

    Otherwise the next file that is opened becomes the standard output: prints get into it, and child processes do not start.
    """
    with contextlib.suppress(OSError):  # A machine without /dev/null, or without free descriptors.
        while (handle := os.open(os.devnull, os.O_RDWR)) <= STANDARD_ERROR:
            os.set_inheritable(handle, True)
        os.close(handle)


def duplicate_above_streams(handle: int) -> int:
    """Duplicate a descriptor to a number above those of the standard streams. The caller closes it."""
    return fcntl.fcntl(handle, fcntl.F_DUPFD_CLOEXEC, STANDARD_ERROR + 1)


@contextlib.contextmanager
def collection_paused(freezes: bool = False) -> Iterator[None]:
    """Context manager that pauses the cyclic garbage collector, for imports and for building worlds, whose many objects stay alive.

    Without it, collections that free nothing take a fifth of the CPU time of importing the modules and building 300 worlds. `freezes`: if
    modules were imported, they pass over what exists by then for good: in a program; garbage of a library's callers would stay, too.
    """
    enabled, imported = gc.isenabled(), len(sys.modules)
    gc.disable()
    try:
        yield
    finally:
        if freezes and len(sys.modules) > imported:
            gc.freeze()
        if enabled:
            gc.enable()
