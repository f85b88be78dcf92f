"""Process pool with ordered results: tasks go to whichever process is idle, results come in the order of the tasks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, NoReturn

from synpick_warp.system.descriptors import open_standard_descriptors
from synpick_warp.system.processes import ProcessError, WorkerProcess, send, start_process

_AHEAD = 8
"""No task is started while this many results per process wait in memory for their turn."""


@dataclass(frozen=True)
class WorkerProgram:
    """Program of the pool's processes."""

    code: str
    """Python code of a process, see `start_process`. It answers the setup, and then each task, with one message."""
    setup: object
    """First message to each process; its answer is dropped."""
    activity: str
    """What the processes do, for messages: "validates"."""


def map_ordered(program: WorkerProgram, tasks: Iterable[Any], processes: int) -> Iterator[Any]:
    """Run tasks in `processes` processes; yields their answers in order. Tasks are taken from the iterable as processes become idle.

    Raises:
        ProcessError: Processes cannot be started, or one died.
    """
    open_standard_descriptors()
    workers: list[WorkerProcess] = []
    try:
        for _ in range(processes):
            workers.append(_start(program))
            _send(workers[-1], program.setup, program)
        for worker in workers:
            _receive(worker, program)
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
                _send(worker, item[1], program)
            if not running:
                return
            for link in wait(list(running)):
                worker, index = running.pop(link)  # pyright: ignore[reportArgumentType]
                done[index] = _receive(worker, program)
                idle.append(worker)
            while turn in done:
                yield done.pop(turn)
                turn += 1
    finally:
        for worker in workers:
            worker.kill()


def _start(program: WorkerProgram) -> WorkerProcess:
    try:
        return start_process(program.code)
    except OSError as error:
        raise ProcessError(f"cannot start a process: {error}; set --threads lower") from error


def _send(worker: WorkerProcess, message: object, program: WorkerProgram) -> None:
    try:
        send(worker.link, message)
    except OSError:
        _fail(worker, program)


def _receive(worker: WorkerProcess, program: WorkerProgram) -> Any:
    try:
        return worker.link.recv()
    except (EOFError, OSError):
        _fail(worker, program)


def _fail(worker: WorkerProcess, program: WorkerProgram) -> NoReturn:
    how, remedy = worker.describe_end("--threads")
    raise ProcessError(f"a process that {program.activity} {how}; {remedy}")
