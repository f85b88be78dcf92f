"""Checksums and manifest entries: SHA-256 lists in the format of `sha256sum`. Runs in writer processes."""

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import MANIFEST_FILE, PARTIAL, checksum_line, is_litter, write_atomically
from synpick_warp.system.inputs.files import path_inside

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")
"""Line of a checksum list: digest and name."""
_RESERVED = (MANIFEST_FILE, "manifest", "config.toml", PARTIAL)
"""First parts of names that no list has: the data set's own records."""
_WHOLE = 1 << 22
"""Largest file that is read at once [bytes]."""
_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY | os.O_NOFOLLOW


def open_regular(path: Path | str) -> int:
    """Open a regular file for reading, no symbolic link, pipe or device; returns the handle. Raises FileNotFoundError, or OSError with the
    reason as `strerror`."""
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


def checksum(path: Path | str, limit: int | None = None) -> str:
    """SHA-256 of a regular file, in hexadecimal. Raises as `open_regular`, and OSError if it is larger than `limit` [bytes]."""
    return _hash_file(path, limit)[0]


def parse_checksums(lines: bytes, folder: Path, source: Path, advice: str) -> dict[str, str]:
    """Parse a checksum list in the format of `sha256sum`: name, relative to the data set -> SHA-256.

    Raises DatasetError, with `source` and `advice` in its message, if the list is not UTF-8, a line is no digest and name, or a name leads
    out of the folder, is one of the data set's own records, or is there twice.
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


def list_files(out: Path, paths: Sequence[Path]) -> list[str]:
    """Expand files and folders into the names of all files in them, relative to the data set, sorted and without duplicates.

    Names are strings: an episode has 100,000 files, and to create a `Path` takes as long as to hash a small file.
    """
    names: set[str] = set()
    for path in map(str, paths):
        names.update(_walk(f"{out}/{path}", path) if os.path.isdir(f"{out}/{path}") else (path,))
    return sorted(names)


def _walk(folder: str, name: str) -> Iterator[str]:
    """Yield the names of all files in a folder and its subfolders but litter, with `name` in place of the folder's path."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if is_litter(entry.name):
                continue
            if entry.is_dir():
                yield from _walk(entry.path, f"{name}/{entry.name}")
            else:
                yield f"{name}/{entry.name}"


def _hash_file(path: Path | str, limit: int | None = None) -> tuple[str, int]:
    """Hash a regular file; returns its SHA-256 in hexadecimal and its size [bytes]."""
    with open(open_regular(path), "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        if limit is not None and size > limit:
            raise OSError(0, "it is larger than all files of its entry together", str(path))
        digest = hashlib.sha256(file.read()) if size <= _WHOLE else hashlib.file_digest(file, "sha256")
        return digest.hexdigest(), size


def spooled_checksums(out: Path, path: Path) -> Path:
    """Temporary list of the `checksum_line`s of a committed file or folder whose format has hashed all as it wrote them."""
    return out / PARTIAL / f"{quote(str(path), safe='')}.sha256"


def write_checksums(out: Path, path: Path, part: Path) -> None:
    """Writer task: write the `checksum_line`s of a file, or of all files in a folder, to `part`: those that its format has spooled, else
    those of the files on disk."""
    try:
        spooled_checksums(out, path).rename(part)
    except FileNotFoundError:
        part.write_bytes("".join(checksum_line(*hashed, name) for name, hashed in _hash_files(out, (path,)).items()).encode())


def join_manifest_entry(out: Path, place: Path, parts: Sequence[Path], content: dict[str, Any]) -> None:
    """Writer task: merge the lists of `write_checksums` into a manifest entry like that of `write_manifest_entry`, and remove them."""
    known: dict[str, tuple[str, int]] = {}
    for part in parts:
        for line in part.read_bytes().splitlines():
            digest, size, name = line.decode().split(" ", 2)
            known[name] = digest, int(size)
    _write_entry(out, place, known, content)
    for part in parts:
        part.unlink()


def write_manifest_entry(out: Path, place: Path, paths: Sequence[Path], content: dict[str, Any]) -> None:
    """Commit files, or folders that hold nothing else: write `place`.sha256 with their checksums, then `place`.json, whose presence marks
    all of them as complete. All paths are relative to the data set; `content`: further keys of the entry, besides file count, size and the
    SHA-256 of the checksum list."""
    _write_entry(out, place, _hash_files(out, paths), content)


def _hash_files(out: Path, paths: Sequence[Path]) -> dict[str, tuple[str, int]]:
    """Hash files, and all files in folders; returns SHA-256 and size [bytes] by name."""
    return {name: _hash_file(f"{out}/{name}") for name in list_files(out, paths)}


def _write_entry(out: Path, place: Path, known: dict[str, tuple[str, int]], content: dict[str, Any]) -> None:
    """Write a manifest entry, as `write_manifest_entry`, of files with known SHA-256 and size [bytes] by name."""
    lines = "".join(f"{known[name][0]}  {name}\n" for name in sorted(known)).encode()
    size = sum(size for _, size in known.values())
    entry = {**content, "files": len(known), "bytes": size, "checksum": hashlib.sha256(lines).hexdigest()}
    write_atomically(out / f"{place}.sha256", lines)
    write_atomically(out / f"{place}.json", (json.dumps(entry, allow_nan=False) + "\n").encode())


def name_parts(out: Path, place: Path, count: int) -> list[Path]:
    """Paths of the `count` temporary checksum lists that are merged into a manifest entry."""
    return [out / PARTIAL / f"{place.name}-{index}.sha256" for index in range(count)]
