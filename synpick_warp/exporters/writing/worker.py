"""Main loop of a writer process: runs tasks on images in memory shared with the bake."""

from __future__ import annotations

import mmap
import os
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from synpick_warp.errors import DatasetError, SynpickError
from synpick_warp.system.processes import serve
from synpick_warp.system.shared_memory import SharedArray

NICENESS = 10
"""Increment of the processes' niceness (nice(2)): when they keep all cores busy, the bake, which feeds them and the GPU, has priority."""


@dataclass(frozen=True)
class TaskMessage:
    """Message to a writer process: call `function(*images, *arguments)`. Functions are pickled by name, so they are top-level ones."""

    function: Callable[..., None]
    images: tuple[SharedArray, ...]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Failure:
    """Error of a task, as a picklable answer."""

    error: str
    """Message in one line; empty for an `OSError`, which `system` describes."""
    system: tuple[int, str, str] | None
    """errno, reason and path of an `OSError`."""
    trace: str
    """Traceback, for developers."""
    is_input: bool = False
    """Whether a file that the task reads is at fault, which the message names."""


def run_task(task: TaskMessage, memory: mmap.mmap) -> Failure | None:
    """Run a task; returns its error, or None after success."""
    try:
        task.function(*(image.map(memory) for image in task.images), *task.arguments)
    except OSError as error:
        system = (error.errno or 0, error.strerror or str(error), str(error.filename or ""))
        return Failure("", system, traceback.format_exc())
    except Exception as error:
        line = str(error) if isinstance(error, SynpickError) else f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Failure(line, None, traceback.format_exc(), isinstance(error, DatasetError))
    return None


def main() -> None:
    """Serve tasks from the socket with handle argv[1] on the memory with handle argv[2], until `None` arrives or the bake is gone."""
    os.nice(NICENESS)
    memory = mmap.mmap(int(sys.argv[2]), 0)
    serve(Connection(int(sys.argv[1])), lambda task: run_task(task, memory))
