"""Folders of any depth."""

from __future__ import annotations

import os
from itertools import takewhile
from pathlib import Path


def make_folder(folder: Path) -> None:
    """Create a folder with its parents, unless it exists: `mkdir -p`. `Path.mkdir` calls itself for each parent, which ends at 1,000.

    Raises:
        OSError: As `Path.mkdir`; FileExistsError: it is a file.
    """
    missing = list(takewhile(lambda each: not os.path.lexists(each), (folder, *folder.parents)))
    for each in reversed(missing or [folder]):
        each.mkdir(exist_ok=True)
