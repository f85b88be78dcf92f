"""Batches of frames on the host: selections of ticks and which arrays they read; waiting for copies, with pauses and errors of devices."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from synpick_warp.stages import host_copies
from synpick_warp.stages.host_copies import HostCopy
from synpick_warp.views.frames import SelectedRows
from tests.worlds.trajectories import ticks

EPISODES = (0, 2, 4, 6)


def test_a_selection_of_a_selection_has_the_rows_of_both():
    (batch,) = ticks(EPISODES, 1)
    chosen = batch.select(np.array([3, 1, 0])).select(np.array([2, 0]))
    assert chosen.episode.tolist() == [0, 6]
    np.testing.assert_array_equal(chosen.pose, batch.pose[[0, 3]])
    for own, whole in ((chosen.tick, batch.tick), (chosen.steps, batch.steps)):
        assert own.keys() == whole.keys()
        for name, values in whole.items():
            np.testing.assert_array_equal(own[name], values[[0, 3]], err_msg=name)


def test_a_selection_reads_rows_when_they_are_asked_for():
    arrays = {"speed": np.arange(4.0), "force": np.arange(4.0)}
    rows = SelectedRows(arrays, np.array([1, 3]))
    arrays["speed"] += 10.0
    assert (len(rows), rows["speed"].tolist()) == (2, [11.0, 13.0])
    rows["speed"][:] = 0.0
    assert rows["speed"].tolist() == [11.0, 13.0]


def test_asking_a_selection_for_a_name_gathers_nothing():
    class Unread(dict[str, np.ndarray]):
        def __getitem__(self, name: str) -> np.ndarray:
            raise AssertionError(f"{name} was read")

    rows = SelectedRows(Unread(speed=np.arange(4.0)), np.array([1]))
    assert "speed" in rows
    assert "force" not in rows


# ---- waiting for copies ----


class FakeEvent:
    """Stand-in for a CUDA event that is complete after a number of queries."""

    def __init__(self, queries: int) -> None:
        self.results = itertools.chain(itertools.repeat(False, queries), itertools.repeat(True))

    @property
    def is_complete(self) -> bool:
        return next(self.results)


def copy_after(queries: int) -> HostCopy:
    copy = HostCopy([wp.zeros(1, dtype=float, device="cpu")])
    copy.done = FakeEvent(queries)
    return copy


@pytest.mark.parametrize(("queries", "pauses"), [(0, 0), (3, 3)])
def test_a_wait_pauses_until_the_copy_is_done(monkeypatch, queries, pauses):
    synchronized, slept = [], []
    monkeypatch.setattr(wp, "synchronize_event", synchronized.append)
    monkeypatch.setattr(host_copies.time, "sleep", slept.append)
    monkeypatch.setattr(host_copies.time, "monotonic", lambda: 7.0)
    copy = copy_after(queries)
    assert copy.wait()[0].tolist() == [0.0]
    assert slept == [host_copies.PAUSE_SECONDS] * pauses
    assert synchronized == [copy.done]


def test_a_failed_copy_is_reported_though_its_event_is_never_complete(monkeypatch):
    def fail(_: FakeEvent) -> None:
        raise RuntimeError("Failed to synchronize event")

    monkeypatch.setattr(wp, "synchronize_event", fail)
    monkeypatch.setattr(host_copies, "MAX_PAUSED_SECONDS", 0.01)
    with pytest.raises(RuntimeError, match="Failed"):
        copy_after(10**9).wait()
