"""Path containment: names read from a file, resolved inside a folder (prevention of path traversal, CWE-22); and folders of any depth."""

from __future__ import annotations

import os
from itertools import takewhile
from pathlib import Path, PurePosixPath

from synpick_warp.errors import SynpickError

MAX_NAME = 4096
"""Longest name in characters: PATH_MAX of Linux."""


def path_inside(folder: Path, name: str, source: object, error: type[SynpickError]) -> Path:
    """Resolve a relative name to a path inside a folder. Nothing has to exist there.

    Symbolic links may lead to other places inside the folder, never out of it.

    Args:
        folder: The folder that must contain the path.
        name: Relative name with "/" between its parts, as read from the file `source`.

    Raises SynpickError: as `error`: the name is empty, absolute, has parts "..", control characters, or leads out of the folder by a link.
    """
    parts = PurePosixPath(name).parts
    if not parts or len(name) > MAX_NAME or ".." in parts or name.startswith("/") or not name.isprintable():
        raise error(f"{source} names the file {_quote(name)}; allowed: a relative name without .. inside {folder}")
    path = folder.joinpath(*parts)
    try:
        root, target = folder.resolve(), path.resolve()
    except (OSError, RuntimeError) as fault:  # A name too long for the file system; links in a circle.
        raise error(f"{source} names the file {_quote(name)}, which cannot be resolved: {fault}") from None
    if target == root or not target.is_relative_to(root):
        raise error(f"{source} names the file {_quote(name)}, which leads out of {folder} by a symbolic link")
    return path


def _quote(name: str) -> str:
    """Name in quotes for a message: cut to 80 characters, unprintable ones escaped."""
    shown = name if len(name) <= 80 else f"{name[:79]}…"
    return f'"{shown.encode("unicode_escape").decode() if not shown.isprintable() else shown}"'


def make_folder(folder: Path) -> None:
    """Create a folder with its parents, unless it exists: `mkdir -p`. `Path.mkdir` calls itself for each parent, which ends at 1,000.
    Raises OSError: as `Path.mkdir`; FileExistsError: it is a file."""
    missing = list(takewhile(lambda each: not os.path.lexists(each), (folder, *folder.parents)))
    for each in reversed(missing or [folder]):
        each.mkdir(exist_ok=True)
