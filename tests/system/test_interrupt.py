"""The first signal asks, the second does what it always did."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType, FunctionType

import pytest

from synpick_warp.system.processes.interrupt import RETRY, SIGNALS, KeptInterrupt, StopRequest


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


def test_without_a_signal_all_is_as_before():
    before = [signal.getsignal(number) for number in SIGNALS]
    with StopRequest() as stop:
        assert [signal.getsignal(number) for number in SIGNALS] != before
    assert [signal.getsignal(number) for number in SIGNALS] == before
    assert stop.number == 0


def test_other_threads_can_use_it():
    numbers = []

    def use() -> None:
        with StopRequest() as stop:
            numbers.append(stop.number)

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert numbers == [0]


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
