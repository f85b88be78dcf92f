"""Isolated processes: a call that crashes, hangs, takes too much memory or is interrupted ends alone."""

from __future__ import annotations

import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.system.processes import isolation
from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated
from tests.harness.environment import checkout_environment

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
    ("function", "arguments", "said"),
    [
        (crash, (signal.SIGSEGV,), "crashed (SIGSEGV)"),
        (os.abort, (), "crashed (SIGABRT)"),
        (os._exit, (3,), "ended with status 3"),
        (math.sqrt, (-1.0,), "failed (ValueError: math domain error)"),
    ],
)
def test_a_call_that_fails_does_so_alone(function, arguments, said):
    assert list(run_isolated(function, [arguments], LIMITS)) == [Failure(said)]
    assert list(run_isolated(math.sqrt, [(4.0,), (9.0,)], LIMITS)) == [2.0, 3.0]


@pytest.mark.parametrize(
    ("function", "arguments", "said"),
    [
        (crash, (signal.SIGKILL,), "was killed, probably for lack of memory"),
        (bytearray, (2**32,), "needs more than 1 GiB of memory"),
    ],
)
def test_what_the_machine_lacks_is_told_apart(function, arguments, said):
    assert list(run_isolated(function, [arguments], LIMITS)) == [Failure(said, by_machine=True)]


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


def test_a_server_that_has_ended_is_started_again():
    list(run_isolated(math.sqrt, [(4.0,)], LIMITS))
    assert isolation._server._worker is not None
    isolation._server._worker.process.kill()
    assert list(run_isolated(math.sqrt, [(4.0,)], LIMITS)) == [2.0]


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
