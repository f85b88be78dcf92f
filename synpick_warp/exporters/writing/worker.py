"""A writer process: runs tasks on images that lie in memory shared with the bake."""

from __future__ import annotations

import mmap
import os
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from synpick_warp.errors import SynpickError

NICENESS = 10
"""Added to the processes' own (nice(2)): when they keep all cores busy, the bake, which feeds them and the GPU, goes first."""


@dataclass(frozen=True)
class SharedImage:
    """Where an image lies in the shared memory."""

    offset: int
    shape: tuple[int, ...]
    dtype: str

    def of(self, memory: mmap.mmap) -> np.ndarray:
        return np.ndarray(self.shape, np.dtype(self.dtype), memory, self.offset)


@dataclass(frozen=True)
class Task:
    """`function(*images, *arguments)`; the function is sent by name, so it stands at the top of a module."""

    function: Callable[..., None]
    images: tuple[SharedImage, ...]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Failure:
    """What went wrong in a task."""

    error: str
    """One line; empty for an `OSError`, which `system` describes."""
    system: tuple[int, str, str] | None
    """errno, reason and path of an `OSError`."""
    trace: str
    """For developers."""


def run(task: Task, memory: mmap.mmap) -> Failure | None:
    """Run a task; returns what went wrong."""
    try:
        task.function(*(image.of(memory) for image in task.images), *task.arguments)
    except OSError as error:
        system = (error.errno or 0, error.strerror or str(error), str(error.filename or ""))
        return Failure("", system, traceback.format_exc())
    except Exception as error:
        line = str(error) if isinstance(error, SynpickError) else f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Failure(line, None, traceback.format_exc())
    return None


def main() -> None:
    """Serve the tasks that come through file handle argv[1] on the memory of handle argv[2], until there is `None` or no bake."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the bake's to handle.
    os.nice(NICENESS)
    link = Connection(int(sys.argv[1]))
    memory = mmap.mmap(int(sys.argv[2]), 0)
    try:
        while (task := link.recv()) is not None:
            link.send(run(task, memory))
    except (EOFError, ConnectionError):
        return  # The bake is gone, and whoever ended it knows.
