"""Ordered parallel map over worker processes: each idle process takes the next task, and results are returned in the order of the tasks."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, NoReturn, TypeVar

from synpick_warp.system.descriptors import open_standard_descriptors
from synpick_warp.system.processes import ProcessError, WorkerProcess, send, serve, start_process

_AHEAD = 8
"""Size of the reorder buffer [results per process]: while it is full, no further task is started."""
_State = TypeVar("_State")


@dataclass(frozen=True)
class WorkerProgram:
    """Program of the worker processes."""

    code: str
    """Python code that imports and calls a main function, which calls `serve_tasks`; see `start_process`."""
    setup: object
    """First message to each process, from which `serve_tasks` makes the state that all tasks share."""
    activity: str
    """Verb for error messages: a process that "validates" was ended."""


def map_ordered(program: WorkerProgram, tasks: Iterable[Any], processes: int) -> Iterator[Any]:
    """Run tasks in worker processes; yields their results in the order of the tasks.

    Args:
        program: Program of the processes.
        tasks: Messages to the processes, taken lazily as processes become idle.
        processes: Number of processes.

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


def serve_tasks(prepare: Callable[[Any], _State], run: Callable[[_State, Any], Any]) -> None:
    """Main loop of a worker process of `map_ordered`, until the parent ends it.

    Args:
        prepare: Makes the state from the setup message.
        run: Returns the result of a task; receives the state and the task.
    """
    states: list[_State] = []

    def answer(message: Any) -> Any:
        if states:
            return run(states[0], message)
        states.append(prepare(message))
        return None

    serve(Connection(int(sys.argv[1])), answer)


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
