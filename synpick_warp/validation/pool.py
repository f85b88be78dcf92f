"""Process pool of a validation: tasks go to whichever process is idle, results come in the order of the tasks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from multiprocessing.connection import wait
from pathlib import Path
from typing import NoReturn

from synpick_warp.errors import DatasetError
from synpick_warp.system.descriptors import open_standard_descriptors
from synpick_warp.system.processes import ProcessError, WorkerProcess, send, start_process
from synpick_warp.validation.tasks import Answer, Checked, State, Task, run_task

_PROGRAM = "from synpick_warp.validation.worker import main; main()"
_AHEAD = 8
"""Tasks per process that may be done before their turn: results wait in memory."""


def run_tasks(folder: Path, tasks: Iterable[Task], processes: int) -> Iterator[Checked]:
    """Run tasks; results come in order.

    Args:
        folder: The data set.
        tasks: The tasks.
        processes: Number of processes; 1: tasks run in this one.

    Raises:
        DatasetError: The data set's folder cannot be read any more.
        ProcessError: Processes cannot be started, or one died.
    """
    if processes > 1:
        yield from _run_parallel(folder, tasks, processes)
        return
    state = State(folder)
    for task in tasks:
        yield _unpack(run_task(task, state))


def _unpack(answer: Answer) -> Checked:
    if answer.checked is None:
        raise DatasetError(answer.error)
    return answer.checked


def _run_parallel(folder: Path, tasks: Iterable[Task], processes: int) -> Iterator[Checked]:
    open_standard_descriptors()
    workers: list[WorkerProcess] = []
    try:
        workers.extend(_start(folder) for _ in range(processes))
        idle = list(workers)
        queue, done, running = iter(enumerate(tasks)), {}, {}
        turn, exhausted = 0, False
        while True:
            while idle and not exhausted and len(done) < _AHEAD * processes:
                item = next(queue, None)
                if item is None:
                    exhausted = True
                    break
                worker = idle.pop()
                running[worker.link] = worker, item[0]
                try:
                    send(worker.link, item[1])
                except OSError:
                    _fail(worker)
            if not running:
                return
            for link in wait(list(running)):
                worker, index = running.pop(link)  # pyright: ignore[reportArgumentType]
                try:
                    done[index] = worker.link.recv()
                except (EOFError, OSError):
                    _fail(worker)
                idle.append(worker)
            while turn in done:
                yield _unpack(done.pop(turn))
                turn += 1
    finally:
        for worker in workers:
            worker.kill()


def _start(folder: Path) -> WorkerProcess:
    """Start a process, and tell it the data set."""
    try:
        worker = start_process(_PROGRAM)
    except OSError as error:
        raise ProcessError(f"cannot start a process: {error}; set --threads lower") from error
    try:
        send(worker.link, folder)
        worker.link.recv()
    except (EOFError, OSError):
        _fail(worker)
    return worker


def _fail(worker: WorkerProcess) -> NoReturn:
    how, remedy = worker.describe_end("--threads")
    raise ProcessError(f"a process that validates {how}; {remedy}")
