"""Worker pool: errors of setup and tasks, order and laziness of the map, and tasks in the calling process."""

from __future__ import annotations

import os
import time
from functools import partial

import pytest

from synpick_warp.errors import DatasetError
from synpick_warp.system.processes.pool import TaskError, WorkerPool, WorkerProgram, map_ordered


def make_list() -> list[int]:
    return []


def refuse(error: Exception) -> None:
    raise error


def throw(_: object, error: Exception) -> None:
    raise error


def sleep_and_return(_: object, index: int, seconds: float) -> int:
    time.sleep(seconds)
    return index


def count(seen: list[int]) -> tuple[int, int]:
    seen.append(0)
    return os.getpid(), len(seen)


def read_handle(_: object, handle: int) -> bytes:
    with os.fdopen(handle, "rb") as file:
        return os.pread(file.fileno(), 100, 0)


PROGRAM = WorkerProgram(make_list, "process that tests")


@pytest.fixture(scope="module")
def pool():
    with WorkerPool(PROGRAM, 2) as pool:
        yield pool


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (DatasetError("a file is damaged"), DatasetError, "a file is damaged"),
        (FileNotFoundError(2, "No such file or directory", "x"), FileNotFoundError, "[Errno 2] No such file or directory: 'x'"),
        (OSError("truncated"), OSError, "[Errno 0] truncated"),
        (MemoryError("of images"), MemoryError, "of images"),
        (ImportError("failed to map segment"), ImportError, "failed to map segment"),
        (ValueError("two\nlines"), TaskError, "ValueError: two lines"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
def test_errors_reach_the_caller_and_all_but_user_errors_have_a_trace(pool, error, kind, text):
    with pytest.raises(kind) as caught:
        pool.wait(pool.submit(partial(throw, error=error)))
    assert str(caught.value) == text
    notes = getattr(caught.value, "__notes__", [])
    assert ["in throw" in note for note in notes] == [True] * (kind is not DatasetError)
    assert pool.wait(pool.submit(partial(sleep_and_return, index=3, seconds=0.0))) == 3


def test_an_error_of_the_setup_is_that_of_each_task():
    with WorkerPool(WorkerProgram(partial(refuse, DatasetError("no data set")), "process that tests"), 2) as pool:
        for _ in range(2):
            with pytest.raises(DatasetError, match="no data set"):
                pool.wait(pool.submit(count))


def test_a_task_that_cannot_be_sent_leaves_no_trace(pool):
    with pytest.raises((AttributeError, TypeError)):
        pool.submit(lambda _: None)
    assert pool.load() == 0


def test_tasks_share_the_state_of_their_process_and_go_to_the_least_busy():
    with WorkerPool(PROGRAM, 2) as pool:
        answers = [pool.wait(future) for future in [pool.submit(count) for _ in range(4)]]
    assert sorted(answers) == sorted((pid, turn) for pid in {pid for pid, _ in answers} for turn in (1, 2))


def test_every_process_receives_what_is_broadcast(pool, tmp_path):
    (tmp_path / "file").write_text("shared")
    with (tmp_path / "file").open() as file:
        futures = pool.broadcast(read_handle, file.fileno())
    assert [pool.wait(future) for future in futures] == [b"shared", b"shared"]


@pytest.mark.parametrize(("depth", "ahead"), [(1, 8), (2, 2)])
def test_a_map_is_ordered_and_takes_tasks_lazily(pool, depth, ahead):
    taken = []

    def tasks():
        for index in range(40):
            taken.append(index)
            yield partial(sleep_and_return, index=index, seconds=0.3 if index == 0 else 0.0)

    for turn, result in enumerate(pool.map_ordered(tasks(), depth=depth, ahead=ahead)):
        assert result == turn
        assert len(taken) <= turn + ahead * len(pool)
    assert len(taken) == 40


@pytest.mark.parametrize("processes", [1, 2])
def test_a_map_of_one_process_runs_in_this_one(processes):
    pids = {pid for pid, _ in map_ordered(PROGRAM, [count] * 8, processes)}
    assert (pids == {os.getpid()}) == (processes == 1)


def test_a_task_here_raises_its_own_error():
    with pytest.raises(ZeroDivisionError) as caught:
        list(map_ordered(PROGRAM, [partial(throw, error=ZeroDivisionError())], 1))
    assert not hasattr(caught.value, "__notes__")


def test_processes_that_cannot_start_are_one_line(monkeypatch):
    started = []

    def start(program, *rest):
        if started:
            raise OSError(11, "Resource temporarily unavailable")
        started.append(real(program, *rest))
        return started[0]

    from synpick_warp.system.processes import pool as module

    real = module.start_process
    monkeypatch.setattr(module, "start_process", start)
    with pytest.raises(module.ProcessError, match=r"cannot start a process that tests: .*unavailable; set --threads lower"):
        WorkerPool(PROGRAM, 2)
    assert started[0].process.returncode is not None
