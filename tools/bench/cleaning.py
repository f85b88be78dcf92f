"""Processes that verify each episode of a running bake as `synpick-warp verify` does, and delete its files, so that the disk does not fill.
They import no simulator."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path
from typing import NamedTuple, Self

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.dataset.commit.manifest import committed_episodes, episode_entry, read_checksums
from synpick_warp.dataset.commit.verify import check_files
from synpick_warp.errors import DatasetError, SynpickError
from synpick_warp.exporters.registry import load_exporter_classes, shared_files
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.processes.pool import WorkerPool, WorkerProgram

LIST_INTERVAL = 0.5
"""Interval at which committed episodes are listed [s]."""
CORES_PER_PROCESS = 4
"""Number of CPU cores per process that verifies; with fewer cores there is one process. Verifying and deleting a view takes less CPU time
than writing it: on an H200's host with 16 cores, 4 processes kept up with 877 full-HD views/s with all masks."""


class Tally(NamedTuple):
    """Counters of a cleaner: verified episodes and files, deleted bytes, first problem (empty: none)."""

    episodes: int = 0
    files: int = 0
    deleted: int = 0
    """Disk space freed by deletion [bytes]."""
    problem: str = ""
    """Description of the first missing or damaged file, after which nothing more is verified; empty: none."""

    def plus(self, other: Tally) -> Tally:
        """Add two tallies; the first problem is kept."""
        return Tally(self.episodes + other.episodes, self.files + other.files, self.deleted + other.deleted, self.problem or other.problem)


@dataclass(frozen=True)
class CleanedSet:
    """Data set whose committed episodes are verified and deleted; manifest entries, and files of others, are kept."""

    out: Path
    folders: tuple[str, ...]
    """Folders shared by several episodes, relative to the data set; they are kept even if empty."""

    def clean(self, episode: int) -> Tally:
        """Verify a committed episode, and delete its files; an episode with a problem is kept."""
        deleted = 0
        try:
            known = read_checksums(self.out, episode_entry(episode))
            if problem := check_files(self.out, known).problem:
                return Tally(problem=problem)
            for name in known:
                deleted += (self.out / name).lstat().st_blocks * 512  # st_blocks counts units of 512 bytes, whatever the file system's.
                (self.out / name).unlink()
        except SynpickError as error:
            return Tally(problem=str(error))
        except OSError as error:
            return Tally(problem=f"{error.filename} cannot be deleted: {error.strerror}")
        self._remove_empty_folders(known)
        return Tally(1, len(known), deleted)

    def _remove_empty_folders(self, names: dict[str, str]) -> None:
        """Remove the parent folders of files `names` that are now empty, except shared folders and their parents."""
        stay = {folder for name in self.folders for folder in (Path(name), *Path(name).parents)} | {Path()}
        folders = {parent for name in names for parent in Path(name).parents} - stay
        for folder in sorted(folders, key=lambda folder: -len(folder.parts)):
            with contextlib.suppress(OSError):  # It holds other files.
                os.rmdir(self.out / folder)


class Cleaner:
    """Pool of processes that verify and delete the episodes of a running bake; a context manager that ends them."""

    def __init__(self, data_set: CleanedSet, processes: int | None = None) -> None:
        """Start `processes` processes; None: a number by CORES_PER_PROCESS."""
        program = WorkerProgram(partial(CleanedSet, data_set.out, data_set.folders), "process that verifies episodes", "bake.worlds")
        self._pool = WorkerPool(program, processes or max(1, count_cores() // CORES_PER_PROCESS))
        self._out, self._known, self._tally, self._listed = data_set.out, set[int](), Tally(), 0.0

    @property
    def pids(self) -> tuple[int, ...]:
        """Ids of the worker processes."""
        return self._pool.pids()

    def poll(self) -> Tally:
        """Hand over new episodes, and return the totals of those that are done; a process that died is a problem."""
        if self._tally.problem:
            return self._tally
        try:
            if time.monotonic() - self._listed >= LIST_INTERVAL:
                self._listed = time.monotonic()
                for episode in sorted(set(committed_episodes(self._out)) - self._known):
                    self._known.add(episode)
                    self._pool.submit(partial(CleanedSet.clean, episode=episode), drain=False)
            while done := self._pool.receive(0.0):
                self._tally = reduce(Tally.plus, (future.result() for future in done), self._tally)
        except SynpickError as error:
            self._tally = self._tally._replace(problem=str(error))
        return self._tally

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.kill()


@contextlib.contextmanager
def clean_up_behind(layout: DataLayout, out: Path) -> Iterator[Cleaner]:
    """Context manager: verify and delete the episodes of a bake to `out` while it runs. Raises DatasetError: an episode was damaged."""
    folders = tuple(map(str, shared_files(load_exporter_classes(layout.formats), layout).folders))
    with Cleaner(CleanedSet(out, folders)) as cleaner:
        yield cleaner
        tally = cleaner.poll()
    if tally.problem:
        raise DatasetError(tally.problem)
