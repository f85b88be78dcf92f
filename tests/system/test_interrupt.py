"""The first signal asks, the second does what it always did."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from synpick_warp.system.interrupt import SIGNALS, StopRequest


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
