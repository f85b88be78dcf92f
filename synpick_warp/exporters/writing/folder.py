"""Writer of many small files in one folder with the fewest system calls: openat relative to the folder's handle, write, close."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

Buffer = bytes | memoryview
"""Contiguous bytes."""
_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC


class Folder:
    """An open folder handle; see `open_folder`."""

    def __init__(self, path: Path, handle: int) -> None:
        self._path = path
        self._handle = handle

    def write(self, name: str, data: Buffer) -> None:
        """Write a file. `name` is relative to the folder; subfolders in it must exist."""
        self._write(name, data, os.O_TRUNC)

    def append(self, name: str, data: Buffer) -> None:
        """Append to a file (O_APPEND). Processes may append at the same time: the bytes of one call stay contiguous."""
        self._write(name, data, os.O_APPEND)

    def _write(self, name: str, data: Buffer, flag: int) -> None:
        """Write all of a file of this folder, opened with `flag`; raises OSError that names it."""
        try:
            handle = os.open(name, _FLAGS | flag, 0o666, dir_fd=self._handle)
            try:
                rest = memoryview(data).cast("B")
                while rest:
                    rest = rest[os.write(handle, rest) :]
            finally:
                os.close(handle)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path / name)) from error


@contextmanager
def open_folder(path: Path) -> Iterator[Folder]:
    """Open a folder handle, so that the kernel resolves the folder's own path once instead of once a file."""
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield Folder(path, handle)
    finally:
        os.close(handle)
