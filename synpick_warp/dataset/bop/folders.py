"""Folder listings confined to a data set: symbolic links that lead out of it are named and never followed."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import read_file


@dataclass(frozen=True)
class Listing:
    """Names in a folder. Files are read by these names only, so that no link leads a reader out of the data set."""

    root: Path
    """The data set, as the user names it."""
    place: str
    """The folder, relative to the root; "" is the root."""
    files: frozenset[str] = frozenset()
    folders: frozenset[str] = frozenset()
    outside: tuple[str, ...] = ()
    """Symbolic links that lead out of the data set, or nowhere."""
    special: tuple[str, ...] = field(default=())
    """Pipes, sockets and devices."""

    def name(self, entry: str) -> str:
        """Path of an entry relative to the root, for messages."""
        return f"{self.place}/{entry}" if self.place else entry

    def path(self, entry: str) -> Path:
        """Path of an entry, from the root of the data set."""
        return self.root / self.name(entry)

    def read(self, entry: str, limit: int) -> bytes:
        """Read a listed file.

        Raises:
            DatasetError: It cannot be read, or is larger than `limit` [B].
        """
        if entry not in self.files:
            raise DatasetError(f"there is no file {self.name(entry)}")
        return read_file(self.path(entry), limit, DatasetError)

    def enter(self, folder: str) -> Listing:
        """List a folder in this one; empty if there is none."""
        return list_folder(self.root, self.name(folder)) if folder in self.folders else Listing(self.root, self.name(folder))


def list_folder(root: Path, place: str = "") -> Listing:
    """List a folder of a data set.

    Args:
        root: The data set.
        place: The folder, relative to the root.

    Raises:
        DatasetError: It cannot be listed.
    """
    files, folders, outside, special = set(), set(), [], []
    try:
        with os.scandir(root / place) as entries:
            for entry in entries:
                if entry.is_symlink() and not _leads_inside(root, entry.path):
                    outside.append(entry.name)
                elif entry.is_dir():
                    folders.add(entry.name)
                elif entry.is_file():
                    files.add(entry.name)
                else:
                    special.append(entry.name)
    except OSError as fault:
        raise DatasetError(f"{root / place} cannot be listed: {fault.strerror}") from None
    return Listing(root, place, frozenset(files), frozenset(folders), tuple(sorted(outside)), tuple(sorted(special)))


def _leads_inside(root: Path, link: str) -> bool:
    """Whether a symbolic link leads to something inside the data set."""
    try:
        target, place = Path(link).resolve(strict=True), root.resolve()
    except (OSError, RuntimeError):
        return False
    return target != place and target.is_relative_to(place)
