"""Checksum verification of a data set: every file against the SHA-256 in its manifest entry, up to the first mismatch."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from synpick_warp.dataset.manifest import (
    CONSTANTS,
    INDICES,
    committed_episodes,
    episode_entry,
    read_checksums,
    read_entry,
    read_manifest,
    read_settings,
)
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.checksums import checksum
from synpick_warp.system.cores import count_cores

_AHEAD = 4
"""Queued files per thread: enough to keep it busy."""


class Verdict(NamedTuple):
    """Result of a verification."""

    problem: str
    """First file that is missing or damaged, and how; empty: none."""
    episodes: int
    """Number of committed episodes."""
    files: int
    """Number of files that were checked."""
    finished: bool
    """Whether the bake finished."""


def verify(folder: Path) -> Verdict:
    """Compare every file of a data set with its checksum from the time of writing; stops at the first mismatch.

    Order: settings, constants, episodes by index, indices.

    Raises:
        DatasetError: The folder is not a data set.
    """
    manifest = read_manifest(folder)
    episodes = committed_episodes(folder)
    files = 0
    finished = False
    try:
        read_settings(folder, manifest)
        indices = read_entry(folder, INDICES)
        finished = indices is not None and indices["episodes"] == episodes
        entries = [CONSTANTS, *map(episode_entry, episodes), *([INDICES] if indices else [])]
        for entry in entries if episodes or indices else []:
            for name, problem in check_files(folder, read_checksums(folder, entry)):
                files += 1
                if problem:
                    return Verdict(f"{folder / name} {problem}", len(episodes), files, finished)
    except (ConfigError, DatasetError) as error:
        return Verdict(str(error), len(episodes), files, finished)
    missing = sorted(set(indices["episodes"]) - set(episodes)) if indices else []
    problem = f"{folder / episode_entry(missing[0])}.json is missing" if missing else ""
    return Verdict(problem, len(episodes), files, finished)


def check_files(folder: Path, known: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Yield (name, problem) of each file, in order; files are read in parallel, with bounded read-ahead."""
    threads = count_cores()
    with ThreadPoolExecutor(threads) as pool:
        names = iter(known)
        while batch := list(islice(names, _AHEAD * threads)):
            yield from zip(batch, pool.map(lambda name: _check_file(folder / name, known[name]), batch), strict=True)


def _check_file(path: Path, expected: str) -> str:
    """Compare a file's checksum; returns the problem, or an empty string."""
    try:
        return "" if checksum(path) == expected else "has changed since it was written: its checksum differs"
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror}"
