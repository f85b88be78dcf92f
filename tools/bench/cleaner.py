"""Background verification of a running bake: verifies each committed episode as `synpick-warp verify` does, then deletes its files.

Episodes are assigned to several processes by index modulo their number. Manifest entries, and files of episodes that have none yet because
they are still being written, are kept. The processes end with the benchmark.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from functools import reduce
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Self

from synpick_warp.dataset.commit.manifest import committed_episodes, episode_entry, read_checksums
from synpick_warp.dataset.commit.verify import check_files
from synpick_warp.errors import SynpickError
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.processes.worker import END_TIMEOUT, WorkerProcess, send, start_process

INTERVAL = 0.5
"""Polling interval for committed episodes [s]."""
CORES_PER_PROCESS = 4
"""Number of CPU cores per process; with fewer cores there is one process. Verifying and deleting a view takes less CPU time than writing
it: on an H200's host with 16 cores, 4 processes kept up with 877 full-HD views/s with all masks."""
_PROGRAM = "from tools.bench.cleaner import main; main()"


@dataclass(frozen=True)
class Assignment:
    """Task of a cleaner's process: data set, and share of the episodes to verify."""

    out: Path
    """Folder of the data set."""
    folders: tuple[str, ...]
    """Folders shared by several episodes, relative to the data set; they are kept even if empty."""
    share: tuple[int, int] = (0, 1)
    """(i, n): only episodes with index % n == i are verified."""


@dataclass(frozen=True)
class Tally:
    """Counters of a cleaner, or of one of its processes: verified episodes and files, bytes deleted, first problem (empty: none)."""

    episodes: int = 0
    """Number of verified episodes."""
    files: int = 0
    """Number of verified files."""
    deleted: int = 0
    """Disk space freed by deletion [bytes]."""
    problem: str = ""
    """Description of the first missing or damaged file, after which the process stops; empty: none."""

    def plus(self, other: Tally) -> Tally:
        """Return the sum of two counters, with the problem of the first that has one."""
        return Tally(self.episodes + other.episodes, self.files + other.files, self.deleted + other.deleted, self.problem or other.problem)


class Cleaner:
    """Handle of the cleaner's processes; a context manager that ends them."""

    def __init__(self, assignment: Assignment, processes: int | None = None) -> None:
        """Start `processes` processes; None: a number by CORES_PER_PROCESS."""
        count = processes or max(1, count_cores() // CORES_PER_PROCESS)
        self._workers = [start_process(_PROGRAM) for _ in range(count)]
        self._tallies = [Tally() for _ in self._workers]
        for index, worker in enumerate(self._workers):
            send(worker.link, replace(assignment, share=(index, count)))

    @property
    def pids(self) -> list[int]:
        """Ids of the worker processes."""
        return [worker.process.pid for worker in self._workers]

    def poll(self) -> Tally:
        """Receive pending messages and return the totals over all processes; a process that died is reported as a problem."""
        self._tallies = [_poll(worker, tally) for worker, tally in zip(self._workers, self._tallies, strict=True)]
        return reduce(Tally.plus, self._tallies)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for worker in self._workers:
            with contextlib.suppress(OSError):
                send(worker.link, None)
        deadline = time.monotonic() + END_TIMEOUT
        for worker in self._workers:
            with contextlib.suppress(subprocess.TimeoutExpired):
                worker.process.wait(max(0.0, deadline - time.monotonic()))
            worker.kill()


def _poll(worker: WorkerProcess, tally: Tally) -> Tally:
    """Receive pending messages of a process; returns its latest counters, given the previous ones in `tally`."""
    has_ended = worker.process.poll() is not None  # Before the last messages are read, which say why.
    with contextlib.suppress(EOFError, OSError):
        while not tally.problem and worker.link.poll():
            tally = worker.link.recv()
    if not tally.problem and has_ended:
        tally = replace(tally, problem=f"a process that verifies episodes {worker.describe_end('bake.worlds')[0]}")
    return tally


def main() -> None:
    """Main function of a process: works on the assignment received over the socket with handle argv[1].

    It ends at another message, or with the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent ends this process.
    link = Connection(int(sys.argv[1]))
    with contextlib.suppress(EOFError, OSError):
        assignment: Assignment = link.recv()
        tally, done = Tally(), set[int]()
        while not tally.problem and not link.poll(INTERVAL):
            index, count = assignment.share
            for episode in sorted(each for each in committed_episodes(assignment.out) if each % count == index and each not in done):
                tally = clean_episode(assignment, episode, tally)
                done.add(episode)
                send(link, tally)
                if tally.problem or link.poll():
                    break


def clean_episode(assignment: Assignment, episode: int, tally: Tally) -> Tally:
    """Verify a committed episode, delete its files, and return the updated counters; an episode with a problem is kept."""
    out = assignment.out
    try:
        known = read_checksums(out, episode_entry(episode))
    except SynpickError as error:
        return replace(tally, problem=str(error))
    if problem := check_files(out, known).problem:
        return replace(tally, problem=problem)
    deleted = 0
    try:
        for name in known:
            deleted += (out / name).lstat().st_blocks * 512  # st_blocks counts units of 512 bytes, whatever the file system's.
            (out / name).unlink()
    except OSError as error:
        return replace(tally, problem=f"{error.filename} cannot be deleted: {error.strerror}")
    _remove_empty_folders(out, known, assignment.folders)
    return replace(tally, episodes=tally.episodes + 1, files=tally.files + len(known), deleted=tally.deleted + deleted)


def _remove_empty_folders(out: Path, names: dict[str, str], shared: tuple[str, ...]) -> None:
    """Remove the parent folders of files `names` that are now empty, except shared folders and their parents."""
    stay = {folder for name in shared for folder in (Path(name), *Path(name).parents)} | {Path()}
    folders = {parent for name in names for parent in Path(name).parents} - stay
    for folder in sorted(folders, key=lambda folder: -len(folder.parts)):
        with contextlib.suppress(OSError):  # It holds other files.
            os.rmdir(out / folder)
