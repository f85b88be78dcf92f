"""Processes and signals: requests to stop, interrupts that libraries swallow, isolated calls that end alone, pools of workers."""

import contextlib
import importlib
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import FrameType, FunctionType

import pytest

from synpick_warp.errors import CatalogError, DatasetError
from synpick_warp.system.processes import isolation
from synpick_warp.system.processes.interrupt import RETRY, SIGNALS, KeptInterrupt, StopRequest
from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated, start_server
from synpick_warp.system.processes.pool import TaskError, WorkerPool, WorkerProgram, map_ordered
from tests.harness.environment import checkout_environment


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_is_noted_and_the_second_is_not(number, capfd):
    heard = []
    before = signal.signal(number, lambda number, _: heard.append(number))
    try:
        with StopRequest() as stop:
            assert stop.number == 0
            os.kill(os.getpid(), number)
            assert (stop.number, heard) == (number, [])
            assert "stopping after this tick" in capfd.readouterr().err
            os.kill(os.getpid(), number)
            assert heard == [number]
        os.kill(os.getpid(), number)
        assert heard == [number, number]
    finally:
        signal.signal(number, before)


def test_without_a_signal_all_is_as_before_and_other_threads_can_use_it():
    before = [signal.getsignal(number) for number in SIGNALS]
    with StopRequest() as stop:
        assert [signal.getsignal(number) for number in SIGNALS] != before
    assert [signal.getsignal(number) for number in SIGNALS] == before

    def use() -> int:
        with StopRequest() as stop:
            return stop.number

    with ThreadPoolExecutor(1) as threads:
        assert threads.submit(use).result() == stop.number == 0


# ---- interrupts that libraries swallow ----

SWALLOWER = """
import os, signal
heard = False
try:
    os.kill(os.getpid(), signal.SIGINT)
    import email.message
except BaseException:
    heard = True
"""


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def swallow() -> None:
    with contextlib.suppress(BaseException):
        interrupt()
        wait()


def stopped(*parts: Callable[[], object]) -> None:
    """The parts are ended by an interrupt, and the handlers are as before."""

    def run() -> None:
        with KeptInterrupt():
            for part in parts:
                part()

    with pytest.raises(KeyboardInterrupt):
        run()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def wait() -> None:
    time.sleep(60)


def test_an_import_is_not_interrupted_but_followed_by_the_interrupt(tmp_path, monkeypatch):
    (tmp_path / "swallower.py").write_text(SWALLOWER)
    monkeypatch.syspath_prepend(tmp_path)
    stopped(lambda: importlib.import_module("swallower"), wait)
    assert not sys.modules.pop("swallower").heard  # type: ignore[attr-defined]


def test_a_second_interrupt_does_not_wait_for_the_import(tmp_path, monkeypatch):
    twice = "import os, signal, time\nfor _ in 1, 2:\n    os.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n"
    (tmp_path / "endless.py").write_text(twice)
    monkeypatch.syspath_prepend(tmp_path)
    stopped(lambda: importlib.import_module("endless"))


@pytest.mark.parametrize("end", [wait, lambda: None, lambda: 1 / 0])
def test_a_swallowed_interrupt_comes_again(end):
    stopped(swallow, end)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGALRM])
@pytest.mark.parametrize("entered", ["__exit__", "setitimer", "signal"])
def test_a_signal_at_the_end_leaves_no_timer(number, entered):
    """A timer that goes on would raise interrupts in whatever runs next, for ever."""
    sent = []

    def send(frame: FrameType, event: str, function: object) -> None:
        name = getattr(function, "__name__", frame.f_code.co_name)
        if event in ("call", "c_call") and name == entered and not sent and frame_of(KeptInterrupt.__exit__, frame):
            sent.append(name)
            os.kill(os.getpid(), number)

    try:
        stopped(swallow, lambda: sys.setprofile(send))
    finally:
        sys.setprofile(None)
    assert sent == [entered]


def frame_of(function: FunctionType, frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code is not function.__code__:
        frame = frame.f_back
    return frame is not None


def test_what_cleans_up_after_an_interrupt_is_not_disturbed():
    done = []

    def clean_up() -> None:
        try:
            interrupt()
        except BaseException:
            time.sleep(3 * RETRY)
            done.append("handler")
            raise
        finally:
            with contextlib.suppress(ValueError):
                raise ValueError
            time.sleep(3 * RETRY)
            done.append("finally")

    stopped(clean_up)
    assert done == ["handler", "finally"]


def test_an_ignored_interrupt_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with KeptInterrupt():
            interrupt()
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    "arguments", [("merge", "NONE", "--out", "OUT"), ("convert", "NONE", "--to", "coco", "--out", "OUT"), ("stats", "NO")]
)
def test_a_command_that_is_interrupted_while_it_imports_says_so(tmp_path, arguments):
    """The stand-in of NumPy takes the interrupt for a missing module, as trimesh does with SciPy."""
    (tmp_path / "numpy.py").write_text(f"{SWALLOWER}\nraise ImportError('no module' if heard else 'not NumPy')\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), os.getcwd()))}
    command = [sys.executable, "-m", "synpick_warp", *arguments]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr, run.stdout) == (130, "synpick-warp: interrupted\n", "")
    assert not (tmp_path / "OUT").exists()


# ---- isolated calls ----


LIMITS = Limits(60.0, 2**30)


def crash(number: int) -> None:
    os.kill(os.getpid(), number)


def complain() -> None:
    raise CatalogError("one line")


def noise() -> int:
    os.write(1, b"on standard output")
    os.write(2, b"on standard error")
    return 7


@pytest.mark.parametrize(
    ("function", "arguments", "said", "by_machine"),
    [
        (crash, (signal.SIGSEGV,), "crashed (SIGSEGV)", False),
        (os.abort, (), "crashed (SIGABRT)", False),
        (os._exit, (3,), "ended with status 3", False),
        (math.sqrt, (-1.0,), "failed (ValueError: math domain error)", False),
        (crash, (signal.SIGKILL,), "was killed, probably for lack of memory", True),
        (bytearray, (2**32,), "needs more than 1 GiB of memory", True),
    ],
)
def test_a_call_that_fails_does_so_alone_and_what_the_machine_lacks_is_told_apart(function, arguments, said, by_machine):
    assert list(run_isolated(function, [arguments], LIMITS)) == [Failure(said, by_machine=by_machine)]
    assert list(run_isolated(math.sqrt, [(4.0,), (9.0,)], LIMITS)) == [2.0, 3.0]


def test_a_call_that_takes_too_long_is_stopped():
    """By its processor time, or by wall time if it sleeps."""
    said = Failure("took longer than 0.1 s of processor time and was stopped", by_machine=True)
    assert list(run_isolated(sum, [(range(10**12),)], Limits(0.1, 2**30))) == [said]
    assert list(run_isolated(time.sleep, [(600.0,), (0.0,)], Limits(0.1, 2**30))) == [said, None]


def test_errors_are_results_and_large_results_arrive(capfd):
    (error,) = run_isolated(complain, [()], LIMITS)
    assert isinstance(error, CatalogError)
    assert str(error) == "one line"
    (data,) = run_isolated(bytearray, [(2**25,)], LIMITS)
    assert len(data) == 2**25
    assert list(run_isolated(noise, [()], LIMITS)) == [7]
    assert capfd.readouterr() == ("", "")


def test_paths_are_relative_to_the_folder_in_which_a_call_is_made(tmp_path, monkeypatch):
    for folder in (tmp_path, tmp_path.parent):
        monkeypatch.chdir(folder)
        assert list(run_isolated(os.getcwd, [()], LIMITS)) == [str(folder)]


def test_a_server_that_has_ended_is_started_again():
    list(run_isolated(math.sqrt, [(4.0,)], LIMITS))
    assert isolation._server._worker is not None
    isolation._server._worker.process.kill()
    assert list(run_isolated(math.sqrt, [(4.0,)], LIMITS)) == [2.0]


def test_a_server_that_was_started_ahead_takes_the_calls():
    isolation._server.stop()
    start_server()
    worker = isolation._server._worker
    assert list(run_isolated(math.sqrt, [(4.0,)], LIMITS)) == [2.0]
    assert worker is not None
    assert isolation._server._worker is worker


def test_calls_that_lose_their_server_share_the_next_one():
    """A call that started another server for itself would end the one that another call waits for."""
    list(run_isolated(math.sqrt, [(4.0,)], LIMITS))
    server, links, request = isolation._server._worker.process, isolation._Links(), pickle.dumps((math.sqrt, (4.0,)))
    server.send_signal(signal.SIGSTOP)
    with ThreadPoolExecutor(8) as threads:
        calls = [threads.submit(links.call, request, LIMITS) for _ in range(8)]
        while len(links._open) < len(calls):
            time.sleep(0.01)
        server.kill()
        assert [call.result() for call in calls] == [2.0] * len(calls)


def test_calls_that_are_left_end_wherever_they_are_collected():
    """The garbage collector may run while a thread starts, which holds the lock that joining a thread takes."""
    results = run_isolated(time.sleep, [(0.0,), (600.0,)], LIMITS)
    next(results)

    def collect() -> None:
        with threading._shutdown_locks_lock:  # type: ignore[attr-defined]
            results.close()  # type: ignore[attr-defined]

    thread = threading.Thread(target=collect, daemon=True)
    thread.start()
    thread.join(20)
    assert not thread.is_alive()


PROGRAM = """
import sys, time
from synpick_warp.system.processes.isolation import Limits, run_isolated
print("started", flush=True)
list(run_isolated(time.sleep, [(600.0,)] * int(sys.argv[1]), Limits(600.0, 2**30)))
"""


@pytest.mark.parametrize("calls", [1, 2])
def test_ctrl_c_ends_all_calls_at_once(calls):
    """Of a single call, too: decompositions of one object ran in the caller, deaf to Ctrl-C."""
    command = [sys.executable, "-c", PROGRAM, str(calls)]
    with subprocess.Popen(command, env=checkout_environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(3.0)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert "KeyboardInterrupt" in errors


# ---- pools of workers ----


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


LISTS = WorkerProgram(make_list, "process that tests")


@pytest.fixture(scope="module")
def pool():
    with WorkerPool(LISTS, 2) as pool:
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
    with pytest.raises((AttributeError, TypeError), match="pickle"):  # A task that cannot be sent leaves no trace.
        pool.submit(lambda _: None)
    assert pool.load() == 0


def test_an_error_of_the_setup_is_that_of_each_task():
    with WorkerPool(WorkerProgram(partial(refuse, DatasetError("no data set")), "process that tests"), 2) as pool:
        for _ in range(2):
            with pytest.raises(DatasetError, match="no data set"):
                pool.wait(pool.submit(count))


def test_tasks_share_the_state_of_their_process_and_go_to_the_least_busy():
    with WorkerPool(LISTS, 2) as pool:
        answers = [pool.wait(future) for future in [pool.submit(count) for _ in range(4)]]
    assert sorted(answers) == sorted((pid, turn) for pid in {pid for pid, _ in answers} for turn in (1, 2))


def test_every_process_receives_what_is_broadcast(pool):
    assert sorted(pool.wait(future)[0] for future in pool.broadcast(count)) == sorted(pool.pids())


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
    pids = {pid for pid, _ in map_ordered(LISTS, [count] * 8, processes)}
    assert (pids == {os.getpid()}) == (processes == 1)


def test_a_task_here_raises_its_own_error():
    with pytest.raises(ZeroDivisionError) as caught:
        list(map_ordered(LISTS, [partial(throw, error=ZeroDivisionError())], 1))
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
        WorkerPool(LISTS, 2)
    assert started[0].process.returncode is not None
