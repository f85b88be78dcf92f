"""Waiting for copies to the host: with pauses, and with the device's error after a failure."""

from __future__ import annotations

import itertools

import pytest
import warp as wp

from synpick_warp.stages import host_copies
from synpick_warp.stages.host_copies import HostCopy


class FakeEvent:
    """Stand-in for a CUDA event that is complete after a number of queries."""

    def __init__(self, queries: int) -> None:
        self.results = itertools.chain(itertools.repeat(False, queries), itertools.repeat(True))

    @property
    def is_complete(self) -> bool:
        return next(self.results)


@pytest.mark.parametrize(("queries", "pauses"), [(0, 0), (3, 3)])
def test_a_wait_pauses_until_the_copy_is_done(monkeypatch, queries, pauses):
    synchronized, slept = [], []
    monkeypatch.setattr(wp, "synchronize_event", synchronized.append)
    monkeypatch.setattr(host_copies.time, "sleep", slept.append)
    monkeypatch.setattr(host_copies.time, "monotonic", lambda: 7.0)
    copy = HostCopy([wp.zeros(1, dtype=float, device="cpu")])
    copy.done = FakeEvent(queries)
    assert copy.wait()[0].tolist() == [0.0]
    assert slept == [host_copies.PAUSE_SECONDS] * pauses
    assert synchronized == [copy.done]


def test_a_failed_copy_is_reported_though_its_event_is_never_complete(monkeypatch):
    def fail(_: FakeEvent) -> None:
        raise RuntimeError("Failed to synchronize event")

    monkeypatch.setattr(wp, "synchronize_event", fail)
    monkeypatch.setattr(host_copies, "MAX_PAUSED_SECONDS", 0.01)
    copy = HostCopy([wp.zeros(1, dtype=float, device="cpu")])
    copy.done = FakeEvent(10**9)
    with pytest.raises(RuntimeError, match="Failed"):
        copy.wait()
