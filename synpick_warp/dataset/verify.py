"""Checks a data set against its own checksums, and says what is the first that does not fit."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from synpick_warp.configs.load import load_config
from synpick_warp.dataset.manifest import (
    CONFIG_FILE,
    CONSTANTS,
    JOINED,
    describe_differences,
    episode_place,
    make_manifest,
    read_checksums,
    read_manifest,
    read_record,
    recorded_episodes,
)
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.checksums import checksum

_AHEAD = 4
"""Files that wait for each thread: enough to keep it busy."""


class Verdict(NamedTuple):
    """What came of the check of a data set."""

    problem: str
    """The first file that is missing or wrong, and how; empty: none."""
    episodes: int
    """Whole ones."""
    files: int
    """That were checked."""
    finished: bool
    """Whether the bake came to its end."""


def verify(folder: Path) -> Verdict:
    """Compare every file of a data set with the checksum that was noted when it was written; stops at the first that differs.

    In this order: settings, constants, episodes by number, lists.

    Raises:
        DatasetError: The folder is no data set.
    """
    manifest = read_manifest(folder)
    episodes = recorded_episodes(folder)
    joined = read_record(folder, JOINED)
    finished = joined is not None and joined.get("episodes") == episodes
    places = [CONSTANTS, *map(episode_place, episodes), *([JOINED] if joined else [])]
    files = 0
    if problem := _check_settings(folder, manifest):
        return Verdict(problem, len(episodes), files, finished)
    for place in places if episodes or joined else []:
        try:
            known = read_checksums(folder, place)
        except DatasetError as error:
            return Verdict(str(error), len(episodes), files, finished)
        for name, problem in _check_files(folder, known):
            files += 1
            if problem:
                return Verdict(f"{folder / name} {problem}", len(episodes), files, finished)
    missing = sorted(set(joined["episodes"]) - set(episodes)) if joined else []
    problem = f"{folder / episode_place(missing[0])}.json is missing" if missing else ""
    return Verdict(problem, len(episodes), files, finished)


def _check_settings(folder: Path, manifest: dict) -> str:
    """Whether the settings are those of the manifest; returns the problem."""
    path = folder / CONFIG_FILE
    try:
        config = load_config(str(path), {})
    except ConfigError as error:
        return str(error)
    said = describe_differences({"settings": make_manifest(config)["settings"]}, {"settings": manifest["settings"]})
    return f"{path} is not as the manifest: {said}" if said else ""


def _check_files(folder: Path, known: dict[str, str]) -> Iterator[tuple[str, str]]:
    """(name, problem) of each file, in order; several are read at a time, but never many ahead."""
    threads = len(os.sched_getaffinity(0))
    with ThreadPoolExecutor(threads) as pool:
        names = iter(known)
        while batch := list(islice(names, _AHEAD * threads)):
            yield from zip(batch, pool.map(lambda name: _check_file(folder / name, known[name]), batch), strict=True)


def _check_file(path: Path, expected: str) -> str:
    try:
        return "" if checksum(path) == expected else "has another checksum than when it was written"
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror}"
