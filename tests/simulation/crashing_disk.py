"""Fault injection into the file system: from the n-th modification of a folder on, each raises `Dead`, as if the process were killed there.

A power cut additionally truncates the files that were not flushed by fsync or syncfs.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, Self

import pytest

from synpick_warp.dataset.commit import writing
from tests.simulation.scheduler import Dead

_CHANGES = ("os.rename", "os.link", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "shutil.rmtree")
"""Audit events of changes, beside `open` for writing (sys.addaudithook)."""
_WRITES = os.O_WRONLY | os.O_RDWR
_disks: list[CrashingDisk] = []
"""Disk that is watched, if any: an audit hook cannot be removed."""


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if _disks and (event == "open" or event in _CHANGES):
        _disks[0].see(event, arguments)


sys.addaudithook(_watch)


class CrashingDisk:
    """Context manager that counts the modifications of a folder, and simulates a crash at one of them."""

    def __init__(self, folder: Path, crash_at: int = 0) -> None:
        """`crash_at`: number of the change from 1 on; 0: none."""
        self.changes = 0
        self._folder, self._crash_at = str(folder), crash_at
        self._synced = {path.stat().st_ino for path in folder.rglob("*") if path.is_file()}
        """Inodes of the files that a power cut leaves intact: those that existed at the start, and those that were flushed by fsync."""
        self._patch = pytest.MonkeyPatch()

    def __enter__(self) -> Self:
        self._patch.setattr(os, "fsync", self._sync)
        self._patch.setattr(writing, "sync_file_system", self._sync_all)
        _disks.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        _disks.remove(self)
        self._patch.undo()

    def see(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Audit hook: count a modification, or crash."""
        path = os.fspath(arguments[0]) if isinstance(arguments[0], (str, os.PathLike)) else ""
        if event == "open":
            mode, flags = arguments[1], arguments[2]
            if not (any(letter in "wxa+" for letter in mode) if mode else flags & _WRITES):
                return
        if not path.startswith(self._folder) and (path.startswith("/") or event != "open"):
            return
        self.changes += 1
        if 0 < self._crash_at <= self.changes:
            raise Dead

    def _sync(self, handle: int) -> None:
        """Replacement of `os.fsync`: records the file, and does not flush it."""
        self._synced.add(os.fstat(handle).st_ino)

    def _sync_all(self, folder: Path) -> None:
        """Replacement of `sync_file_system`: records all files."""
        self._synced |= {path.stat().st_ino for path in folder.rglob("*") if path.is_file()}

    def cut_power(self) -> None:
        """Truncate all files that were not flushed to half of their size."""
        for root, _, names in os.walk(self._folder):
            for name in names:
                path = os.path.join(root, name)
                state = os.stat(path)
                if state.st_ino not in self._synced:
                    os.truncate(path, state.st_size // 2)
