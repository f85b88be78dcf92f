"""Checksums of what lies in a data set, as `sha256sum` writes and checks them. Runs in writer processes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from synpick_warp.exporters.writing.files import write_atomically


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_below(out: Path, paths: Sequence[Path]) -> list[Path]:
    """Every file that these files and folders are or hold, once, relative to the data set, sorted by name."""
    found: list[Path] = []
    for path in paths:
        place = out / path
        found += [one.relative_to(out) for one in _files(place)] if place.is_dir() else [path]
    return sorted(set(found), key=str)


def _files(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.is_dir():
            yield from _files(path)
        else:
            yield path


def write_manifest_entry(out: Path, place: Path, paths: Sequence[Path], content: dict[str, Any]) -> None:
    """Note files as whole: write `place`.sha256 with their checksums, then `place`.json, which says by being there that all is.

    Args:
        out: Folder of the data set.
        place: Where the record goes, relative to it, without suffix.
        paths: Files, or folders of nothing else, relative to the data set.
        content: What the record says besides number, size and common checksum of the files.
    """
    files = files_below(out, paths)
    lines = "".join(f"{checksum(out / path)}  {path}\n" for path in files).encode()
    size = sum((out / path).stat().st_size for path in files)
    record = {**content, "files": len(files), "bytes": size, "checksum": hashlib.sha256(lines).hexdigest()}
    write_atomically(out / f"{place}.sha256", lines)
    write_atomically(out / f"{place}.json", (json.dumps(record, allow_nan=False) + "\n").encode())
