"""Background verification of a running bake: verifies each committed episode as `synpick-warp verify` does, then deletes its files.

One process; it ends with the benchmark. Files of episodes without a manifest entry, which are still written, are left alone, and so are
manifest entries.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Self

from synpick_warp.dataset.manifest import committed_episodes, episode_entry, read_checksums
from synpick_warp.dataset.verify import check_files
from synpick_warp.errors import SynpickError
from synpick_warp.system.processes import END_TIMEOUT, send, start_process

INTERVAL = 0.5
"""Time between two searches for committed episodes [s]."""
_PROGRAM = "from tools.bench.cleaner import main; main()"


@dataclass(frozen=True)
class Assignment:
    """Data set to clean, and which files are deleted."""

    out: Path
    """Folder of the data set."""
    folders: tuple[str, ...]
    """Folders that episodes share, relative to it, which stay."""
    suffixes: tuple[str, ...] = ()
    """Suffixes of the files that are deleted; empty: all."""


@dataclass(frozen=True)
class Tally:
    """Totals of a cleaner."""

    episodes: int = 0
    """Verified episodes."""
    files: int = 0
    """Verified files."""
    deleted: int = 0
    """Space of the deleted files [bytes]."""
    problem: str = ""
    """First file that is missing or damaged, and how; the cleaner ends with it. Empty: none."""


class Cleaner:
    """Handle of a cleaner's process; a context manager that ends it."""

    def __init__(self, assignment: Assignment) -> None:
        self.tally = Tally()
        self._worker = start_process(_PROGRAM)
        send(self._worker.link, assignment)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._worker.process.pid

    def poll(self) -> Tally:
        """Latest totals; a process that died is a problem."""
        with contextlib.suppress(EOFError, OSError):
            while not self.tally.problem and self._worker.link.poll():
                self.tally = self._worker.link.recv()
        if not self.tally.problem and self._worker.process.poll() is not None:
            self.tally = replace(self.tally, problem=f"the process that verifies scenes {self._worker.describe_end('bake.worlds')[0]}")
        return self.tally

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            send(self._worker.link, None)
            self._worker.process.wait(END_TIMEOUT)
        self._worker.kill()


def main() -> None:
    """Serve one assignment from the socket with handle argv[1], until a message arrives or the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent ends this process.
    link = Connection(int(sys.argv[1]))
    with contextlib.suppress(EOFError, OSError):
        assignment: Assignment = link.recv()
        tally, done = Tally(), set[int]()
        while not tally.problem and not link.poll(INTERVAL):
            for episode in sorted(set(committed_episodes(assignment.out)) - done):
                tally = clean_episode(assignment, episode, tally)
                done.add(episode)
                send(link, tally)
                if tally.problem or link.poll():
                    break


def clean_episode(assignment: Assignment, episode: int, tally: Tally) -> Tally:
    """Verify a committed episode, delete its files, and add both to the totals; with a problem nothing is deleted."""
    out = assignment.out
    try:
        known = read_checksums(out, episode_entry(episode))
    except SynpickError as error:
        return replace(tally, problem=str(error))
    for name, problem in check_files(out, known):
        if problem:
            return replace(tally, problem=f"{out / name} {problem}")
    deleted = 0
    for name in known:
        if not assignment.suffixes or name.endswith(assignment.suffixes):
            deleted += (out / name).lstat().st_blocks * 512  # st_blocks counts units of 512 bytes, whatever the file system's.
            (out / name).unlink()
    _remove_empty_folders(out, known, assignment.folders)
    return replace(tally, episodes=tally.episodes + 1, files=tally.files + len(known), deleted=tally.deleted + deleted)


def _remove_empty_folders(out: Path, names: dict[str, str], shared: tuple[str, ...]) -> None:
    """Remove the folders of files `names` that are now empty, but for shared ones and folders around these."""
    stay = {folder for name in shared for folder in (Path(name), *Path(name).parents)} | {Path()}
    folders = {parent for name in names for parent in Path(name).parents} - stay
    for folder in sorted(folders, key=lambda folder: -len(folder.parts)):
        with contextlib.suppress(OSError):  # It holds other files.
            os.rmdir(out / folder)
