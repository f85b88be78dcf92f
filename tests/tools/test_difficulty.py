"""The report on difficulty, on a data set whose visibility and speeds are known."""

from __future__ import annotations

import json
import sys

import pytest

from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.dataset.reading import open_data_set
from tests.worlds.evaluation_set import SPEED, VISIBILITY, write_evaluation_set
from tools.reports import difficulty


def test_known_difficulty(tmp_path, monkeypatch, capsys):
    """Four instances in each view, at four visible fractions; one moves faster than MOVING."""
    folder = write_evaluation_set(tmp_path / "set")
    found = difficulty.measure_difficulty(read_truth(open_data_set(folder)))
    assert list(found) == ["all", "move", "pick"]
    for name, values in found.items():
        assert values == pytest.approx(
            {
                "episodes": 2 if name == "all" else 1,
                "instances a view": 4,
                "mean visibility": sum(VISIBILITY) / 4,
                "below 0.5 [%]": 50,
                "above 0.05 m/s [%]": 25,
                "median speed of these [m/s]": max(SPEED),
                "95th percentile of speed [m/s]": max(SPEED),
            }
        )
    file = tmp_path / "run.json"
    monkeypatch.setattr(sys, "argv", ["difficulty", str(folder), "--json", str(file)])
    assert difficulty.main() == 0
    rows = {row["name"]: row["value"] for row in json.loads(file.read_text())["rows"]}
    assert rows["move: instances a view"] == 4
    printed = capsys.readouterr().out
    assert "metallic 0.25, roughness 0.45 on average" in printed
    assert "median speed of these [m/s]" in printed


def test_a_folder_that_is_no_data_set_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["difficulty", str(tmp_path)])
    assert difficulty.main() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("reports.difficulty: ")
