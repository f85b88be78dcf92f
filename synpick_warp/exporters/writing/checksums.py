"""Checksums and manifest entries: SHA-256 lists in the format of `sha256sum`. Runs in writer processes."""

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
