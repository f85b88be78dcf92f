"""Determinism check across world counts: comparison of runs, and error messages."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.builders import ONE_OBJECT, assignments
from tools.compare import worlds as tool

FEW_STEPS = ("--episodes", "2", "--ticks", "12", *assignments(ONE_OBJECT | {"bake.mode": "move", "physics.steps_per_tick": 4}))


def tick(catalog_index: int, *x: float) -> tuple[np.ndarray, np.ndarray]:
    """State after a tick: one object, and poses at the given x [m]."""
    poses = np.zeros((len(x), 7), np.float32)
    poses[:, 0] = x
    return np.array([catalog_index], np.int32), poses


def test_equal_runs():
    run = {(0, 0): [tick(1, 0.0, 0.1)] * 3, (1, 0): [tick(2, 0.5)]}
    assert tool.compare(run, run) == (4, 0, -1, 0.0)


def test_ticks_of_only_one_run_are_not_compared():
    assert tool.compare({(0, 0): [tick(1, 0.0)] * 3, (1, 0): [tick(1, 0.0)]}, {(0, 0): [tick(1, 0.0)] * 2}) == (2, 0, -1, 0.0)


def test_first_and_largest_difference_are_reported():
    still, moved, far = tick(1, 0.0, 0.1), tick(1, 0.0, 0.102), tick(1, 0.004, 0.1)
    other = {(0, 0): [still, still, moved, far], (1, 0): [still]}
    count, differing, first, largest = tool.compare({(0, 0): [still] * 4, (1, 0): [still]}, other)
    assert (count, differing, first) == (5, 1, 2)
    assert largest == pytest.approx(4.0, rel=1e-5)


def test_another_object_is_a_difference():
    assert tool.compare({(0, 0): [tick(1, 0.0)]}, {(0, 0): [tick(2, 0.0)]})[:3] == (1, 1, 0)
    assert tool.compare({(0, 0): [tick(1, 0.0)]}, {(0, 0): [tick(1, 0.0, 0.0)]})[:3] == (1, 1, 0)


def test_episodes_do_not_depend_on_the_world_count(tmp_path):
    assert tool.main(["--device", "cpu", "--worlds", "2,1", *FEW_STEPS, "--json", str(tmp_path / "runs.json")]) == 0
    runs = json.loads((tmp_path / "runs.json").read_text())
    assert [(run["worlds"], run["recorded"]) for run in runs] == [(2, False), (2, False), (1, False), (1, True)]
    assert all(run["deterministic"] and not run["differing"] and run["largest"] == 0.0 for run in runs)
    assert [run["ticks"] for run in runs[:2]] == [24, 24]


@pytest.mark.parametrize("text", ["", "0", "2,x", "2,,3", "-1"])
def test_invalid_world_counts_are_errors(capsys, text):
    with pytest.raises(SystemExit) as stop:
        tool.main([f"--worlds={text}"])
    assert stop.value.code == 2
    assert "is not a list of world counts" in capsys.readouterr().err


def test_a_missing_models_folder_is_an_error(capsys, tmp_path):
    assert tool.main(["--device", "cpu", "--models", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.startswith("compare worlds: models folder")
