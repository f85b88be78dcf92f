"""Execution of a validation's tasks in the calling process or in worker processes; results are in the order of the tasks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from synpick_warp.errors import DatasetError
from synpick_warp.system.ordered_pool import WorkerProgram, map_ordered
from synpick_warp.validation.tasks import Answer, Checked, State, Task, run_task

_PROGRAM = "from synpick_warp.validation.worker import main; main()"


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
        yield from map(_unpack, map_ordered(WorkerProgram(_PROGRAM, folder, "validates"), tasks, processes))
        return
    state = State(folder)
    for task in tasks:
        yield _unpack(run_task(task, state))


def _unpack(answer: Answer) -> Checked:
    if answer.checked is None:
        raise DatasetError(answer.error)
    return answer.checked
