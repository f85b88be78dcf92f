"""Checksums and manifest entries: SHA-256 lists in the format of `sha256sum`. Runs in writer processes."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import PARTIAL, write_atomically
from synpick_warp.inputs.paths import path_inside

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")
"""Line of a checksum list: digest and name."""
_RESERVED = ("manifest.json", "manifest", "config.toml", ".partial")
"""First parts of names that no list has: the data set's own records."""
_WHOLE = 1 << 22
"""Largest file that is read at once [bytes]."""
_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY | os.O_NOFOLLOW


def open_regular(path: Path | str) -> int:
    """Open a regular file for reading, no symbolic link, pipe or device; returns the handle.

    Raises:
        FileNotFoundError: There is no such file.
        OSError: It cannot be read; `strerror` is the reason.
    """
    try:
        handle = os.open(path, _FLAGS)
    except OSError as error:
        if os.path.islink(path):
            raise OSError(error.errno, "it is a symbolic link", str(path)) from None
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(0, "it is not a regular file", str(path))
    return handle


def checksum(path: Path) -> str:
    """SHA-256 of a regular file, in hexadecimal. Raises as `open_regular`."""
    return _hash_file(path)[0]


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
    return [Path(name) for name in _list_names(out, paths)]


def _list_names(out: Path, paths: Sequence[Path]) -> list[str]:
    """The same as strings: an episode has 100,000 files."""
    names: set[str] = set()
    for path in map(str, paths):
        names.update(_walk(f"{out}/{path}", path) if os.path.isdir(f"{out}/{path}") else (path,))
    return sorted(names)


def _walk(folder: str, name: str) -> Iterator[str]:
    """Names of the files in a folder, which is called `name`, and in its subfolders."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _walk(entry.path, f"{name}/{entry.name}")
            else:
                yield f"{name}/{entry.name}"


def _hash_file(path: Path | str) -> tuple[str, int]:
    """SHA-256, in hexadecimal, and size [bytes] of a regular file."""
    with open(open_regular(path), "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        digest = hashlib.sha256(file.read()) if size <= _WHOLE else hashlib.file_digest(file, "sha256")
        return digest.hexdigest(), size


def _list_checksums(out: Path, paths: Sequence[Path]) -> tuple[list[str], int]:
    """Lines of the checksum list of files, or of folders' files, and their size [bytes]."""
    lines, total = [], 0
    for name in _list_names(out, paths):
        digest, size = _hash_file(f"{out}/{name}")
        lines.append(f"{digest}  {name}\n")
        total += size
    return lines, total


def write_checksums(out: Path, path: Path, part: Path) -> None:
    """Task: write the checksum list of a file, or of a folder's files, to `part`, below a line with their size [bytes]."""
    lines, total = _list_checksums(out, (path,))
    part.write_text("".join((f"{total}\n", *lines)))


def join_manifest_entry(out: Path, place: Path, parts: Sequence[Path], content: dict[str, Any]) -> None:
    """Task: commit the files whose checksums `write_checksums` has written to `parts`; removes these. See `write_manifest_entry`."""
    lists = [part.read_text().splitlines(keepends=True) for part in parts]
    lines = list(itertools.chain.from_iterable(known[1:] for known in lists))
    _write_entry(out, place, lines, sum(int(known[0]) for known in lists), content)
    for part in parts:
        part.unlink()


def write_manifest_entry(out: Path, place: Path, paths: Sequence[Path], content: dict[str, Any]) -> None:
    """Commit files: write `place`.sha256 with their checksums, then `place`.json, whose presence marks all of them as complete.

    Args:
        out: Folder of the data set.
        place: Path of the manifest entry, relative to it, without suffix.
        paths: Files, or folders that hold nothing else, relative to the data set.
        content: Further keys of the entry, besides file count, size and the SHA-256 of the checksum list.
    """
    _write_entry(out, place, *_list_checksums(out, paths), content)


def _write_entry(out: Path, place: Path, lines: list[str], size: int, content: dict[str, Any]) -> None:
    lines.sort(key=lambda line: line.partition("  ")[2].removesuffix("\n"))
    text = "".join(lines).encode()
    entry = {**content, "files": len(lines), "bytes": size, "checksum": hashlib.sha256(text).hexdigest()}
    write_atomically(out / f"{place}.sha256", text)
    write_atomically(out / f"{place}.json", (json.dumps(entry, allow_nan=False) + "\n").encode())


def name_parts(out: Path, place: Path, count: int) -> list[Path]:
    """Places for `count` parts of the checksum list of a manifest entry."""
    return [out / PARTIAL / f"{place.name}-{index}.sha256" for index in range(count)]
