"""Checksums and manifest entries: SHA-256 lists in the format of `sha256sum`. Runs in writer processes."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import write_atomically
from synpick_warp.inputs.paths import path_inside

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")
"""Line of a checksum list: digest and name."""
_RESERVED = ("manifest.json", "manifest", "config.toml", ".partial")
"""First parts of names that no list has: the data set's own records."""
_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY | os.O_NOFOLLOW


def open_regular(path: Path) -> int:
    """Open a regular file for reading, no symbolic link, pipe or device; returns the handle.

    Raises:
        FileNotFoundError: There is no such file.
        OSError: It cannot be read; `strerror` is the reason.
    """
    try:
        handle = os.open(path, _FLAGS)
    except OSError as error:
        if path.is_symlink():
            raise OSError(error.errno, "it is a symbolic link", str(path)) from None
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(0, "it is not a regular file", str(path))
    return handle


def checksum(path: Path) -> str:
    """SHA-256 of a regular file, in hexadecimal. Raises as `open_regular`."""
    with open(open_regular(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def parse_checksums(lines: bytes, folder: Path, source: Path, advice: str) -> dict[str, str]:
    """Parse a checksum list: name -> SHA-256. Every name is inside the folder, and none is one of the data set's own records.

    Args:
        lines: The list, in the format of `sha256sum`.
        folder: The data set, which its names are relative to.
        source: The file, for messages.
        advice: What to do if it is damaged.

    Raises:
        DatasetError: A line is no digest and name, a name leads out of the folder, or is there twice.
    """
    known: dict[str, str] = {}
    folders: set[str] = set()
    try:
        text = lines.decode()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{source} is damaged: byte {error.start} is not UTF-8; {advice}") from None
    for number, line in enumerate(text.removesuffix("\n").split("\n") if text else (), start=1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise DatasetError(f"{source}, line {number}, is damaged: it is not a SHA-256 and a name; {advice}")
        digest, name = match.groups()
        parent, _, last = name.rpartition("/")
        # Resolving a path takes several system calls: once for each folder, and for those of its names that are links.
        plain = not name.startswith("/") and last not in (".", "..") and last.isprintable()
        if parent not in folders or not plain or os.path.islink(f"{folder}/{name}"):
            path_inside(folder, name, f"{source}, line {number},", DatasetError)
            folders.add(parent)
        if name in known or name != str(Path(name)) or name.partition("/")[0] in _RESERVED:
            raise DatasetError(f"{source}, line {number}, is damaged: it names a file twice, or one of the data set's records; {advice}")
        known[name] = digest
    return known


def list_files(out: Path, paths: Sequence[Path]) -> list[Path]:
    """Expand files and folders into the files they hold, each once, relative to the data set, sorted by name."""
    files: set[Path] = set()
    for path in paths:
        absolute = out / path
        files.update((file.relative_to(out) for file in _walk(absolute)) if absolute.is_dir() else (path,))
    return sorted(files, key=str)


def _walk(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.is_dir():
            yield from _walk(path)
        else:
            yield path


def write_manifest_entry(out: Path, place: Path, paths: Sequence[Path], content: dict[str, Any]) -> None:
    """Commit files: write `place`.sha256 with their checksums, then `place`.json, whose presence marks all of them as complete.

    Args:
        out: Folder of the data set.
        place: Path of the manifest entry, relative to it, without suffix.
        paths: Files, or folders that hold nothing else, relative to the data set.
        content: Further keys of the entry, besides file count, size and the SHA-256 of the checksum list.
    """
    files = list_files(out, paths)
    lines = "".join(f"{checksum(out / path)}  {path}\n" for path in files).encode()
    size = sum((out / path).stat().st_size for path in files)
    entry = {**content, "files": len(files), "bytes": size, "checksum": hashlib.sha256(lines).hexdigest()}
    write_atomically(out / f"{place}.sha256", lines)
    write_atomically(out / f"{place}.json", (json.dumps(entry, allow_nan=False) + "\n").encode())
