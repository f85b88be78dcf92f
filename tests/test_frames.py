"""Batches of host-side frames: selections of ticks, and which arrays they read."""

from __future__ import annotations

import numpy as np

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
