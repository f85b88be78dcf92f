"""Check of the names in a data set's checksum lists, of constants and of episodes: only those that its formats write.

A list in a folder that somebody else made could name `.git/hooks/post-checkout` or `Makefile`; files are copied by lists, so a list is
compared with the names in `FORMAT_TABLE` first. They follow from the settings alone.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable
from pathlib import Path

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.dataset.commit.manifest import CONSTANTS, MAX_SHOWN, entry_advice
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.formats import format_table


@functools.lru_cache(maxsize=4)
def _pattern(layout: DataLayout, entry: Path) -> re.Pattern[str]:
    """Regular expression of the file names that the formats write in an entry: of an episode, or the constants."""
    formats = [format_table()[name] for name in dict.fromkeys(layout.formats)]
    names = (row.constants if entry == CONSTANTS else row.episode(layout, int(entry.name)) for row in formats)
    return re.compile("|".join(dict.fromkeys(names)))


def check_file_names(folder: Path, entry: Path, names: Iterable[str], layout: DataLayout) -> None:
    """Check that a checksum list names only files that the formats of a data set write.

    Args:
        folder: The data set.
        entry: Manifest entry of the list: of the constants, or of an episode.
        names: Names in the list, relative to the data set.
        layout: Layout of the data set.

    Raises:
        DatasetError: It names another file.
    """
    matches = _pattern(layout, entry).fullmatch
    foreign = next((name for name in names if not matches(name)), None)
    if foreign is not None:
        raise DatasetError(
            f'{folder / entry}.sha256 names "{foreign[:MAX_SHOWN]}", which none of its formats writes; {entry_advice(entry)}'
        )


def describe_strays(folder: Path, layout: DataLayout, episodes: Iterable[int]) -> str:
    """Name what lies beside the parts that indices are joined from and belongs to no committed episode.

    Args:
        folder: The data set.
        layout: Its layout.
        episodes: Its committed episodes.

    Returns:
        A sentence; empty: there is nothing.
    """
    strays = []
    known = set(episodes)
    for name, row in format_table().items():
        part = row.part
        if part is not None and part.joined and name in layout.formats and (folder / part.folder).is_dir():
            count = layout.cameras if part.per_scene else 1
            parts = {f"{number:06d}{part.suffix}" for episode in known for number in range(count * episode, count * (episode + 1))}
            strays += sorted(f"{part.folder}/{entry.name}" for entry in os.scandir(folder / part.folder) if entry.name not in parts)
    if not strays:
        return ""
    more = f" and {len(strays) - 1} more" if len(strays) > 1 else ""
    return f"left out: {folder}/{ascii(strays[0])[1:-1][:MAX_SHOWN]}{more}, of no committed episode"
