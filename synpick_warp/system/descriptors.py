"""Descriptors of the standard streams: closed ones are opened on the null device, so that no other file takes their numbers."""

from __future__ import annotations

import contextlib
import fcntl
import os

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
