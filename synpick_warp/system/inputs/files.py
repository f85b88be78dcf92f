"""Bounded file reads: regular files up to a size limit; never blocks on a pipe, never reads a device."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from synpick_warp.errors import SynpickError

_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
_BLOCK = 1 << 20
"""Read at a time after the stated size [bytes]."""


def read_file(path: Path | str, limit: int, error: type[SynpickError]) -> bytes:
    """Read a regular file of at most `limit` bytes, or what a symbolic link to one names. Raises SynpickError: as `error`, in one line:
    there is no such file, it is not a regular file, is too large, or cannot be read."""
    data = read_file_if_present(path, limit, error)
    if data is None:
        raise error(f"there is no file {path}")
    return data


def read_file_if_present(path: Path | str, limit: int, error: type[SynpickError]) -> bytes | None:
    """Read a regular file as `read_file`; None: there is no such file."""
    try:
        handle = os.open(path, _FLAGS)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as fault:  # ValueError: a name with a null byte.
        raise error(f"{path} cannot be read: {getattr(fault, 'strerror', None) or fault}") from None
    try:
        state = os.fstat(handle)
        if not stat.S_ISREG(state.st_mode):
            raise error(f"{path} is not a regular file")
        data = _read_all(handle, state.st_size, limit) if state.st_size <= limit else None
    except OSError as fault:
        raise error(f"{path} cannot be read: {fault.strerror}") from None
    finally:
        os.close(handle)
    if data is None or len(data) > limit:
        raise error(f"{path} is larger than {describe_bytes(limit)}, the limit for such files")
    return data


def _read_all(handle: int, size: int, limit: int) -> bytes:
    """Read to the end, or one byte more than `limit`: a file may be longer than the `size` that it has stated."""
    data = os.read(handle, size + 1)
    if len(data) == size:
        return data
    parts = [data]
    while data and (left := limit + 1 - sum(map(len, parts))) > 0:
        data = os.read(handle, min(left, _BLOCK))
        parts.append(data)
    return b"".join(parts)


def check_regular_file(path: Path, limit: int, error: type[SynpickError]) -> None:
    """Check that a library may open a path by name: a regular file up to `limit` bytes. Raises as `read_file`."""
    try:
        state = path.stat()
    except FileNotFoundError:
        raise error(f"there is no file {path}") from None
    except (OSError, ValueError) as fault:
        raise error(f"{path} cannot be read: {getattr(fault, 'strerror', None) or fault}") from None
    if not stat.S_ISREG(state.st_mode):
        raise error(f"{path} is not a regular file")
    if state.st_size > limit:
        raise error(f"{path} is larger than {describe_bytes(limit)}, the limit for such files")


def describe_bytes(count: int) -> str:
    """Format a size, rounded down to whole KiB, MiB or GiB."""
    for unit, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if count >= size:
            return f"{count // size} {unit}"
    return f"{count} bytes"
