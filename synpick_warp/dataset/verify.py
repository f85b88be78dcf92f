"""Checksum verification of a data set: every file against the SHA-256 in its manifest entry, up to the first mismatch.

Data sets of many files are read by several processes. The result does not depend on their number.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from multiprocessing.connection import Connection
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
from synpick_warp.system.ordered_pool import WorkerProgram, map_ordered
from synpick_warp.system.processes import serve

Report = Callable[[str, int, int], None]
"""Progress: unit, number done, total."""
_PART = 256
"""Files of a task: with fewer, the messages to processes take longer than small files."""
_FILES_PER_PROCESS = 10_000
"""Minimum number of files per process: starting one takes 0.2 s, in which this one checks some 10,000 small files."""
_LINE = 100
"""Typical length of a line of a checksum list [bytes]."""
_PROGRAM = "from synpick_warp.dataset.verify import main; main()"


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


class FileList(NamedTuple):
    """Task: files to check, or a problem that was found before."""

    checksums: dict[str, str]
    """SHA-256 by path, relative to the data set."""
    entries: int
    """Number of manifest entries whose files are listed to the end by this task and those before."""
    problem: str = ""
    """Why the list of the next entry cannot be read; empty: it can."""


class Checked(NamedTuple):
    """Result of a task."""

    files: int
    """Number of files that were checked."""
    entries: int
    """As of the task."""
    problem: str
    """First problem; empty: none."""


def verify(folder: Path, threads: int = 1, report: Report = lambda unit, done, total: None) -> Verdict:
    """Compare every file of a data set with its checksum from the time of writing; stops at the first mismatch.

    Order: settings, constants, episodes by index, indices.

    Args:
        folder: The data set.
        threads: Maximum number of processes.
        report: Called with the progress.

    Raises:
        DatasetError: The folder is not a data set.
        ProcessError: Processes cannot be started, or one died.
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
        for checked in _check_entries(folder, entries if episodes or indices else [], threads):
            files += checked.files
            if checked.problem:
                return Verdict(checked.problem, len(episodes), files, finished)
            report("parts", checked.entries, len(entries))
    except (ConfigError, DatasetError) as error:
        return Verdict(str(error), len(episodes), files, finished)
    missing = sorted(set(indices["episodes"]) - set(episodes)) if indices else []
    problem = f"{folder / episode_entry(missing[0])}.json is missing" if missing else ""
    return Verdict(problem, len(episodes), files, finished)


def _check_entries(folder: Path, entries: Sequence[Path], threads: int) -> Iterator[Checked]:
    """Check the files of manifest entries in tasks of up to _PART files; results come in order."""
    tasks = _list_files(folder, entries)
    processes = min(threads, _estimate_files(folder, entries) // _FILES_PER_PROCESS)
    if processes > 1:
        yield from map_ordered(WorkerProgram(_PROGRAM, folder, "verifies"), tasks, processes)
    else:
        yield from (check_files(folder, task) for task in tasks)


def _estimate_files(folder: Path, entries: Sequence[Path]) -> int:
    """Approximate number of files, from the sizes of the checksum lists."""
    lists = [folder / f"{entry}.sha256" for entry in entries]
    return sum(path.stat().st_size for path in lists if path.exists()) // _LINE


def _list_files(folder: Path, entries: Sequence[Path]) -> Iterator[FileList]:
    """Tasks of the entries, in order; ends at an entry that cannot be read."""
    for number, entry in enumerate(entries):
        try:
            items = iter(read_checksums(folder, entry).items())
        except DatasetError as error:
            yield FileList({}, number, str(error))
            return
        part = dict(islice(items, _PART))
        while following := dict(islice(items, _PART)):
            yield FileList(part, number)
            part = following
        yield FileList(part, number + 1)


def check_files(folder: Path, files: FileList) -> Checked:
    """Compare files with their checksums, in order, up to the first problem."""
    for number, (name, expected) in enumerate(files.checksums.items(), 1):
        path = f"{folder}/{name}"  # Joining paths as strings takes a fifth less time for a small file.
        if problem := _check_file(path, expected):
            return Checked(number, files.entries, f"{path} {problem}")
    return Checked(len(files.checksums), files.entries, files.problem)


def _check_file(path: str, expected: str) -> str:
    """Compare a file's checksum; returns the problem, or an empty string."""
    try:
        return "" if checksum(path) == expected else "has changed since it was written: its checksum differs"
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror}"


def main() -> None:
    """Main function of a process: serves tasks from the socket with handle argv[1]; the first message is the data set's folder."""
    folders: list[Path] = []

    def answer(message: Path | FileList) -> Checked | None:
        if isinstance(message, FileList):
            return check_files(folders[0], message)
        folders.append(message)
        return None

    serve(Connection(int(sys.argv[1])), answer)
