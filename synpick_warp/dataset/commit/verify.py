"""Checksum verification of a data set: compares the SHA-256 of every file with its manifest entry, and stops at the first mismatch.

Large data sets are verified by several processes; the result is the same for any number of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import (
    CONSTANTS,
    INDICES,
    committed_episodes,
    episode_entry,
    read_checksums,
    read_entry,
    read_manifest,
    read_settings,
)
from synpick_warp.dataset.commit.plausibility import check_file_names, check_frames, check_listed_frames
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.checksums import checksum
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.processes.pool import WorkerProgram, map_ordered
from synpick_warp.system.progress import Report, ignore_progress

_FILES_PER_PROCESS, _BYTES_PER_PROCESS = 10_000, 1 << 28
"""Minimum amount of work per worker process, in files and in bytes; one of the two suffices. On a Xeon with cached files either takes about
0.2 s, which is also the start-up time of a process."""
_ENTRIES_PER_PROCESS = 4
"""Minimum number of manifest entries per process for which each entry is a single task; fewer entries are split for load balancing."""
_PARTS_PER_PROCESS = 4
"""Number of tasks per process into which an entry is split."""


class Verdict(NamedTuple):
    """Result of a verification: first problem (empty: none), committed episodes, checked files, whether the bake finished."""

    problem: str
    episodes: int
    files: int
    finished: bool


class CheckPart(NamedTuple):
    """Task: check one of `parts` equal parts of the files that a manifest entry lists."""

    entry: Path
    part: int = 0
    """Index of the part."""
    parts: int = 1


class Checked(NamedTuple):
    """Result of a task: number of checked files, and the first problem (empty: none)."""

    files: int
    """Number of checked files, including the damaged one."""
    problem: str


def verify(folder: Path, threads: int | None = None, report: Report = ignore_progress) -> Verdict:
    """Verify the checksum of every file of a data set, as recorded when it was written; stops at the first mismatch.

    Order: settings, constants, episodes by index, indices; then, whether an episode that the indices list is missing.

    Args:
        folder: The data set.
        threads: Maximum number of processes; None: one per core.
        report: Receives the number of checked files.

    Raises:
        DatasetError: The folder is not a data set, or its manifest is damaged.
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
        entries = [CONSTANTS, *map(episode_entry, episodes), *([INDICES] if indices else [])] if episodes or indices else []
        total, size = _count_files(folder, entries)
        for checked in _check_entries(folder, entries, min(threads or count_cores(), _useful_processes(total, size))):
            files += checked.files
            if checked.problem:
                return Verdict(checked.problem, len(episodes), files, finished)
            report("files", files, total)
    except (ConfigError, DatasetError) as error:
        return Verdict(str(error), len(episodes), files, finished)
    missing = sorted(set(indices["episodes"]) - set(episodes)) if indices else []
    problem = f"{folder / episode_entry(missing[0])}.json is missing" if missing else ""
    return Verdict(problem, len(episodes), files, finished)


def _count_files(folder: Path, entries: Sequence[Path]) -> tuple[int, int]:
    """Number and total size [bytes] of the files of all entries. Damaged entries are skipped here; `check_part` reports them."""
    files = size = 0
    for entry in entries:
        try:
            content = read_entry(folder, entry)
        except DatasetError:
            continue
        if content is not None:
            files, size = files + content["files"], size + content["bytes"]
    return files, size


def _useful_processes(files: int, size: int) -> int:
    """Number of processes beyond which another one would take longer to start than it saves; at least 1."""
    return max(1, files // _FILES_PER_PROCESS, size // _BYTES_PER_PROCESS)


def _check_entries(folder: Path, entries: Sequence[Path], processes: int) -> Iterator[Checked]:
    """Check the files of manifest entries, in parallel if `processes` > 1; yields the results in the order of the files."""
    parts = 1 if processes == 1 or len(entries) >= _ENTRIES_PER_PROCESS * processes else _PARTS_PER_PROCESS * processes
    tasks = (partial(_Checker.check, task=CheckPart(entry, part, parts)) for entry in entries for part in range(parts))
    return map_ordered(WorkerProgram(partial(_Checker, folder), "process that verifies"), tasks, processes)


class _Checker:
    """State of a process: the data set's folder, and the checksum list that was read last; successive parts are usually of one entry."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read = lru_cache(maxsize=1)(read_checksums)

    def check(self, task: CheckPart) -> Checked:
        """Task: check a part of the files. See `check_part`."""
        return check_part(self._folder, task, self._read)


def check_part(folder: Path, task: CheckPart, read: Callable[[Path, Path], dict[str, str]] = read_checksums) -> Checked:
    """Check the checksums of a part of a manifest entry's files, up to the first problem.

    Part 0 also checks, before, that the list has the file names that the settings imply, and after, an episode's number of frames.

    Args:
        folder: The data set.
        task: The part.
        read: Reads the checksum list of an entry.
    """
    try:
        known = read(folder, task.entry)
        if task.part == 0 and task.entry != INDICES:
            check_file_names(folder, task.entry, known, DataLayout.of(_read_config(folder)))
    except (ConfigError, DatasetError) as error:
        return Checked(0, str(error))
    first, end = (len(known) * (task.part + step) // task.parts for step in (0, 1))
    limit = (read_entry(folder, task.entry) or {}).get("bytes")
    checked = check_files(folder, dict(islice(known.items(), first, end)), limit)
    if task.part == 0 and not checked.problem:
        return checked._replace(problem=_check_counts(folder, task.entry, known))
    return checked


def _check_counts(folder: Path, entry: Path, known: Mapping[str, str]) -> str:
    """Compare an episode's number of frames with its files; returns the problem, or an empty string, as for entries of no episode."""
    if entry in (CONSTANTS, INDICES):
        return ""
    try:
        layout, row = DataLayout.of(_read_config(folder)), (read_entry(folder, entry) or {})["row"]
        check_listed_frames(folder, layout, row, known)
        check_frames(folder, layout, row["episode"], row["frames"])
    except DatasetError as error:
        return str(error)
    return ""


@lru_cache(maxsize=1)
def _read_config(folder: Path) -> Config:
    """Read the settings of a data set, checked against its manifest."""
    return read_settings(folder, read_manifest(folder))


def check_files(folder: Path, known: Mapping[str, str], limit: int | None = None) -> Checked:
    """Check files in the given order, up to the first problem; returns their number and the problem.

    Args:
        folder: The data set.
        known: Expected SHA-256 of each file, by path relative to the data set.
        limit: Largest size of a file [bytes], such as the sum of all; a larger file is a problem and not read: it may be a sparse
            file of terabytes. None: any size.
    """
    for number, (name, expected) in enumerate(known.items(), 1):
        if problem := _check_file(f"{folder}/{name}", expected, limit):  # Faster than Path's operator by a fifth of a small file's time.
            return Checked(number, f"{folder / name} {problem}")
    return Checked(len(known), "")


def _check_file(path: str, expected: str, limit: int | None) -> str:
    """Compare a file's checksum; returns the problem, or an empty string."""
    try:
        return "" if checksum(path, limit) == expected else "has changed since it was written: its checksum differs"
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror}"
