"""tools/checks/compare_worlds.py: what counts as the same, and that it says what it cannot simulate."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tools.checks import compare_worlds as tool

FEW = (
    "--episodes",
    "2",
    "--ticks",
    "12",
    "--set",
    "arrangement.volume=1e-3",
    "--set",
    "arrangement.max_objects=1",
    "--set",
    "bake.mode=move",
    "--set",
    "physics.substeps=1",
    "--set",
    "physics.steps_per_tick=4",
)
"""One object, and few steps."""


def tick(entry: int, *x: float) -> tuple[np.ndarray, np.ndarray]:
    """One object, and poses that differ in x [m]."""
    poses = np.zeros((len(x), 7), np.float32)
    poses[:, 0] = x
    return np.array([entry], np.int32), poses


def test_the_same_ticks_are_the_same():
    run = {(0, 0): [tick(1, 0.0, 0.1)] * 3, (1, 0): [tick(2, 0.5)]}
    assert tool.compare(run, run) == (4, 0, -1, 0.0)


def test_what_only_one_run_came_to_is_not_compared():
    assert tool.compare({(0, 0): [tick(1, 0.0)] * 3, (1, 0): [tick(1, 0.0)]}, {(0, 0): [tick(1, 0.0)] * 2}) == (2, 0, -1, 0.0)


def test_the_first_difference_and_the_largest_are_told():
    still, moved, far = tick(1, 0.0, 0.1), tick(1, 0.0, 0.102), tick(1, 0.004, 0.1)
    other = {(0, 0): [still, still, moved, far], (1, 0): [still]}
    count, differing, first, largest = tool.compare({(0, 0): [still] * 4, (1, 0): [still]}, other)
    assert (count, differing, first) == (5, 1, 2)
    assert largest == pytest.approx(4.0, rel=1e-5)


def test_another_object_is_a_difference():
    assert tool.compare({(0, 0): [tick(1, 0.0)]}, {(0, 0): [tick(2, 0.0)]})[:3] == (1, 1, 0)
    assert tool.compare({(0, 0): [tick(1, 0.0)]}, {(0, 0): [tick(1, 0.0, 0.0)]})[:3] == (1, 1, 0)


def test_episodes_are_the_same_in_any_number_of_worlds(tmp_path):
    assert tool.main(["--device", "cpu", "--worlds", "2,1", *FEW, "--json", str(tmp_path / "runs.json")]) == 0
    runs = json.loads((tmp_path / "runs.json").read_text())
    assert [(run["worlds"], run["recorded"]) for run in runs] == [(2, False), (2, False), (1, False), (1, True)]
    assert all(run["deterministic"] and not run["differing"] and run["largest"] == 0.0 for run in runs)
    assert [run["ticks"] for run in runs[:2]] == [24, 24]


@pytest.mark.parametrize("text", ["", "0", "2,x", "2,,3", "-1"])
def test_wrong_numbers_of_worlds_are_refused(capsys, text):
    with pytest.raises(SystemExit) as stop:
        tool.main([f"--worlds={text}"])
    assert stop.value.code == 2
    assert "is no list of numbers of worlds" in capsys.readouterr().err


def test_models_that_are_not_there_are_named(capsys, tmp_path):
    assert tool.main(["--device", "cpu", "--models", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.startswith("compare_worlds: models folder")
