"""Files and folders of a data set: written whole, and kept."""

from __future__ import annotations

import contextlib
import os
import uuid
from pathlib import Path

from synpick_warp.errors import OutputError

PARTIAL = ".partial"
"""Folder in the data set for what is not whole yet: on the same file system, so that a rename moves it into place."""
MANIFEST_FILE = "manifest.json"
"""By which a folder is known as a data set."""
_ALLOWED = "--out takes a new or an empty folder"


def check_output_folder(out: Path) -> None:
    """Make sure that a data set can be written to a folder, and leave nothing behind.

    Raises:
        OutputError: The folder holds something else than a data set, or cannot be made or written.
    """
    made = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    try:
        out.mkdir(parents=True, exist_ok=True)
        # Hidden names are what a bake leaves that was killed before its first file was whole.
        if not (out / MANIFEST_FILE).exists() and any(not path.name.startswith(".") for path in out.iterdir()):
            raise OutputError(f"{out} is not empty; {_ALLOWED}, or a data set to go on with")
        probe = out / f".{uuid.uuid4().hex}"
        probe.write_bytes(b"\0")
        probe.unlink()
    except FileExistsError:
        raise OutputError(f"{out} is a file; {_ALLOWED}") from None
    except OSError as error:
        raise output_error(out, error) from error
    finally:
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def output_error(path: Path | str, error: OSError) -> OutputError:
    """What the operating system said about a file, as one line."""
    reason = error.strerror or str(error) or type(error).__name__
    return OutputError(f"cannot write {error.filename or path}: {reason}; free space or rights there, or name another folder with --out")


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that it is there entirely or not at all, even after a power cut."""
    beside = path.with_name(f".{path.name}.new")
    try:
        write_synced(beside, data)
        beside.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise
    sync_folder(path.parent)


def write_synced(path: Path, data: bytes) -> None:
    """Write a file through to the disk."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_file(path: Path) -> None:
    """Write through to the disk what somebody else wrote into a file."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Write a folder's list of names through to the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
