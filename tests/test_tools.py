"""The measuring tools: what they compute, and that they run on small worlds. No number of a measurement is asserted."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from synpick_warp.configs.schema import Config

FOLDER = Path(__file__).resolve().parent.parent / "tools"
FEW = (
    "--device", "cpu", "--set", "arrangement.volume=1e-3", "--set", "arrangement.max_objects=1",
    "--set", "physics.substeps=1", "--set", "physics.steps_per_tick=10", "--set", "settle.min_time=0.1", "--set", "settle.rest_ticks=2",
)
"""One object a world, and as few steps as bring it to rest."""


def load_tool(name: str):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # Where its dataclasses look up their annotations.
    spec.loader.exec_module(module)
    return module


rest_report = load_tool("rest_report")
bench = load_tool("bench")


def pile(**changes):
    """Two objects at rest, well within all bounds."""
    values = {
        "episode": 0, "ticks": 30, "redrops": 0, "volume": 6.5, "energy": 0.0, "tick_speed": np.full(2, 0.01), "speed": np.full(2, 0.1),
        "depth": np.full(2, 0.5), "inside": np.full(2, True),
    }
    return rest_report.Pile(**values | changes)


def violated(findings) -> list[str]:
    return [row.name for row in rest_report.report(findings) if not row.holds]


def test_a_calm_pile_keeps_all_bounds():
    assert violated(rest_report.Findings([pile(), pile()])) == []


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"speed": np.full(2, 0.3)}, ["speed, instantaneous, median"]),
        ({"tick_speed": np.full(2, 0.3)}, ["speed, by displacement over a tick, median"]),
        ({"depth": np.array([0.1, 2.0])}, ["penetration, 99 %"]),
        ({"depth": np.array([0.1, np.nan])}, ["penetration, 99 %"]),
        ({"inside": np.array([True, False])}, ["objects inside the tote"]),
        ({"volume": 7.01}, ["total volume, max"]),
    ],
)
def test_each_bound_is_kept(changes, names):
    assert violated(rest_report.Findings([pile(**changes)])) == names


def test_without_a_pile_nothing_holds():
    assert len(violated(rest_report.Findings(given_up=1))) == 6


def test_inside_is_the_rims_opening_from_the_floor_to_a_heap_above_the_rim():
    config = Config()
    length, width = config.tote.rim_size
    rim = config.tote.outer_size[2] - config.tote.wall
    places = np.array(
        [[0, 0, 0.01], [0, 0, -0.001], [0.499 * length, 0, 0.1], [0.501 * length, 0, 0.1], [0, -0.501 * width, 0.1],
         [0, 0, rim + 0.09], [0, 0, rim + 0.11], [np.nan, 0, 0.1]]
    )
    assert rest_report.is_inside(config, places).tolist() == [True, False, True, False, False, True, False, False]


def test_place_of_turns_then_moves():
    half = np.sqrt(0.5)
    pose = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, half, half]])  # A quarter turn about z.
    place, turn = rest_report.place_of(pose, np.array([[1.0, 0.0, 0.5]]))
    np.testing.assert_allclose(place, [[1.0, 3.0, 3.5]], atol=1e-12)
    np.testing.assert_allclose(turn[0] @ turn[0].T, np.eye(3), atol=1e-12)


def test_arrangements_may_outnumber_worlds(tmp_path):
    file = tmp_path / "rest.json"
    code = rest_report.main(["--arrangements", "2", "--worlds", "1", "--seed", "1", "--json", str(file), *FEW])
    record = json.loads(file.read_text())["rows"]
    rows = {row["name"]: row["value"] for row in record}
    assert code == (0 if all(row["holds"] for row in record) else 1)
    assert rows["arrangements at rest"] == 2
    assert rows["objects"] == 2
    assert rows["objects inside the tote"] == 100.0


def test_bench_measures_every_part_of_small_worlds(tmp_path, monkeypatch, capsys):
    for name in ("FALL_TICKS", "SETTLE_TICKS", "STIR_TICKS", "LEAST_REPEATS", "BURST", "STREAM_BATCHES"):
        monkeypatch.setattr(bench, name, 1)
    monkeypatch.setattr(bench, "WRITE_VIEWS", 3)
    monkeypatch.setattr(bench, "BAKE_SPEED", 10.0)
    file = tmp_path / "bench.json"
    assert bench.main(["--worlds", "1", "--resolution", "32x18", "--seconds", "0", "--json", str(file), *FEW]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["part"] for row in rows} == {"setup", *bench.PARTS}
    assert all(row["value"] >= 0.0 for row in rows)
    assert "views, all stages" in capsys.readouterr().out


@pytest.mark.parametrize("tool", [rest_report, bench], ids=lambda tool: tool.__name__)
def test_mistakes_are_one_line(tool, capsys):
    assert tool.main(["--device", "cuda:99"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_gpu_script_is_bash_and_wants_a_folder():
    done = subprocess.run(["bash", FOLDER / "gpu_run.sh"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("usage:")
