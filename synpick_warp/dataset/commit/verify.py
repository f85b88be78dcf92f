"""Checksum verification of a data set: compares the SHA-256 of every file with its manifest entry, and stops at the first mismatch.

Large data sets are verified by several processes; the result is the same for any number of them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit import manifest as manifests
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.files import checksum
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
_Reader = Callable[[Path, Path], dict[str, str]]
"""Reads the checksum list of an entry, as `read_checksums`."""


class Verdict(NamedTuple):
    """Result of a verification: first problem (empty: none), committed episodes, checked files, whether the bake finished."""

    problem: str
    episodes: int
    files: int
    finished: bool


class Checked(NamedTuple):
    """Result of a task: number of checked files, and the first problem (empty: none)."""

    files: int
    """Number of checked files, including the damaged one."""
    problem: str


def verify(folder: Path, threads: int | None = None, report: Report = ignore_progress) -> Verdict:
    """Verify the checksum of every file of a data set, as recorded when it was written; stops at the first mismatch.

    Order: settings, constants, episodes by index, indices; then, whether an episode that the indices list is missing. Takes at most
    `threads` processes, None: one per core. Raises DatasetError if the folder is not a data set, or its manifest is damaged, and
    ProcessError if processes cannot be started, or one died.
    """
    _read_config.cache_clear()  # Another data set may be there now.
    manifest = manifests.read_manifest(folder)
    episodes = manifests.committed_episodes(folder)
    files = 0
    finished = False
    try:
        manifests.read_settings(folder, manifest)
        indices = manifests.read_entry(folder, manifests.INDICES)
        finished = indices is not None and indices["episodes"] == episodes
        entries = (
            [manifests.CONSTANTS, *map(manifests.episode_entry, episodes), *([manifests.INDICES] if indices else [])]
            if episodes or indices
            else []
        )
        total, size = _count_files(folder, entries)
        processes = max(1, total // _FILES_PER_PROCESS, size // _BYTES_PER_PROCESS)
        for checked in _check_entries(folder, entries, min(threads or count_cores(), processes)):
            files += checked.files
            if checked.problem:
                return Verdict(checked.problem, len(episodes), files, finished)
            report("files", files, total)
    except (ConfigError, DatasetError) as error:
        return Verdict(str(error), len(episodes), files, finished)
    missing = sorted(set(indices["episodes"]) - set(episodes)) if indices else []
    problem = f"{folder / manifests.episode_entry(missing[0])}.json is missing" if missing else ""
    return Verdict(problem, len(episodes), files, finished)


def _count_files(folder: Path, entries: Sequence[Path]) -> tuple[int, int]:
    """Number and total size [bytes] of the files of all entries. Damaged entries are skipped here; `check_part` reports them."""
    files = size = 0
    for entry in entries:
        try:
            content = manifests.read_entry(folder, entry)
        except DatasetError:
            continue
        if content is not None:
            files, size = files + content["files"], size + content["bytes"]
    return files, size


def _check_entries(folder: Path, entries: Sequence[Path], processes: int) -> Iterator[Checked]:
    """Check the files of manifest entries, in parallel if `processes` > 1; yields the results in the order of the files."""
    parts = 1 if processes == 1 or len(entries) >= _ENTRIES_PER_PROCESS * processes else _PARTS_PER_PROCESS * processes
    tasks = (partial(check_part, folder, entry, part, parts) for entry in entries for part in range(parts))
    return map_ordered(WorkerProgram(_cached_reader, "process that verifies"), tasks, processes)


def _cached_reader() -> _Reader:
    """State of a process: `read_checksums` with the list that it read last; successive parts are usually of one entry."""
    return lru_cache(maxsize=1)(manifests.read_checksums)


def check_part(folder: Path, entry: Path, part: int = 0, parts: int = 1, read: _Reader = manifests.read_checksums) -> Checked:
    """Task: check the checksums of one of `parts` equal parts of the files of a manifest entry, up to the first problem.

    Part 0 also checks, before, that the list has the file names that the settings imply, and after, an episode's number of frames.
    """
    checked = Checked(0, "")
    try:
        known, content = read(folder, entry), manifests.read_entry(folder, entry) or {}
        layout = DataLayout.of(_read_config(folder)) if part == 0 and entry != manifests.INDICES else None
        if layout is not None:
            manifests.check_file_names(folder, entry, known, layout)
        first, end = (len(known) * (part + step) // parts for step in (0, 1))
        checked = check_files(folder, dict(islice(known.items(), first, end)), content.get("bytes"))
        if layout is not None and entry != manifests.CONSTANTS and not checked.problem:
            row = content["row"]
            manifests.check_listed_frames(folder, layout, row, known)
            manifests.check_frames(folder, layout, row["episode"], row["frames"])
    except (ConfigError, DatasetError) as error:
        return checked._replace(problem=str(error))
    return checked


@lru_cache(maxsize=1)
def _read_config(folder: Path) -> Config:
    """Read the settings of a data set, checked against its manifest."""
    return manifests.read_settings(folder, manifests.read_manifest(folder))


def check_files(folder: Path, known: Mapping[str, str], limit: int | None = None) -> Checked:
    """Check files, by path relative to the data set and SHA-256, in the given order, up to the first problem; returns their number and the
    problem. A file larger than `limit` [bytes], such as the sum of all, is a problem and not read: it may be a sparse file of terabytes."""
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
