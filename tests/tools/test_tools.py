"""Reports and benchmarks: their statistics and bounds, and that they run on small worlds. Measured values are not asserted."""

from __future__ import annotations

import json
import shutil
import time
from types import SimpleNamespace

import numpy as np
import pytest

from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.schema import Config
from tests.builders import FEW_STEPS, assignments
from tools.bench import __main__ as bench
from tools.bench import run, worlds
from tools.figures import read_runs
from tools.reports import rest as rest_report

SMALL_IMAGES = {
    "perception.resolution": [160, 90],
    "perception.contour_points": 512,
    "perception.contour_offset": 1.5,
    "perception.min_votes": 2.0,
    "perception.normal_window": 2,
}
"""Small images for perception."""
SHORT_EPISODES = {
    "pick.appear_height": 0.2,
    "pick.speed": 4.0,
    "pick.near_speed": 0.5,
    "pick.lift_height": 0.2,
    "pick.lift_speed": 2.0,
    "pick.failures": 1,
    "settle.rest_displacement": 1e-3,
}
"""Short picking episodes."""
SHORT_PICKS = (*FEW_STEPS, *assignments(SMALL_IMAGES | SHORT_EPISODES))


def pile(**changes):
    """A pile of two objects at rest, well within all bounds."""
    values = {
        "episode": 0,
        "ticks": 30,
        "redrops": 0,
        "volume": 6.5,
        "energy": 0.0,
        "tick_speed": np.full(2, 0.01),
        "speed": np.full(2, 0.1),
        "depth": np.full(2, 0.5),
        "inside": np.full(2, True),
    }
    return rest_report.RestingPile(**values | changes)


SETTINGS = Config()


def violated(results, config=SETTINGS) -> list[str]:
    """Names of the report's rows whose bound is violated."""
    return [row.name for row in rest_report.report(results, config.physics, bool(config.arrangement.counts)) if not row.holds]


def test_a_settled_pile_is_within_all_bounds():
    assert violated(rest_report.RestResults([pile(), pile()])) == []


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
def test_each_bound_is_checked(changes, names):
    assert violated(rest_report.RestResults([pile(**changes)])) == names


def test_fills_by_number_may_have_any_volume_but_not_more_contacts_than_there_is_room_for():
    config = Config().with_values({"arrangement.counts": (("bracket", 150, 150),)})
    assert violated(rest_report.RestResults([pile(volume=28.0)]), config) == []
    assert violated(rest_report.RestResults([pile()], contacts=512.0, pairs=1024.0), config) == [
        "contacts a world, most in a tick",
        "pairs of shapes a world, most in a tick",
    ]


def test_without_piles_all_bounds_are_violated():
    assert len(violated(rest_report.RestResults(given_up=1))) == 6


def test_inside_is_within_the_rim_from_the_floor_to_the_heap_height():
    config = Config()
    length, width = config.tote.rim_size
    rim = config.tote.outer_size[2] - config.tote.wall
    positions = np.array(
        [
            [0, 0, 0.01],
            [0, 0, -0.001],
            [0.499 * length, 0, 0.1],
            [0.501 * length, 0, 0.1],
            [0, -0.501 * width, 0.1],
            [0, 0, rim + 0.09],
            [0, 0, rim + 0.11],
            [np.nan, 0, 0.1],
        ]
    )
    assert rest_report.is_inside(BinSizes.of_tote(config.tote), positions).tolist() == [True, False, True, False, False, True, False, False]


def test_transform_points_rotates_then_translates():
    half = np.sqrt(0.5)
    pose = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, half, half]])  # 90° about z.
    position, rotation = rest_report.transform_points(pose, np.array([[1.0, 0.0, 0.5]]))
    np.testing.assert_allclose(position, [[1.0, 3.0, 3.5]], atol=1e-12)
    np.testing.assert_allclose(rotation[0] @ rotation[0].T, np.eye(3), atol=1e-12)


def test_more_arrangements_than_worlds(tmp_path):
    file = tmp_path / "rest.json"
    code = rest_report.main(["--arrangements", "2", "--worlds", "1", "--seed", "1", "--json", str(file), *FEW_STEPS])
    record = read_runs(tmp_path)[file.name].rows
    rows = {row.name: row.value for row in record}
    assert code == (0 if all(row.holds for row in record) else 1)
    assert rows["arrangements at rest"] == 2
    assert rows["objects"] == 2
    assert rows["objects inside the tote"] == 100.0


@pytest.mark.slow
def test_bench_measures_every_part_of_small_worlds(tmp_path, monkeypatch, capsys):
    for name in ("FALL_TICKS", "SETTLE_TICKS", "STIR_TICKS", "LEAD_TICKS", "PICK_TICKS", "STREAM_BATCHES"):
        monkeypatch.setattr(worlds, name, 1)
    for target in ("run.MIN_REPEATS", "run.BURST", "meter.LEAD_TICKS"):
        monkeypatch.setattr(f"tools.bench.{target}", 1)
    # Other tests write to and delete from the file system whose used space is measured.
    unchanged = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: unchanged)
    file = tmp_path / "bench.json"
    small = ("--worlds", "1", "--resolution", "32x18", "--seconds", "0", "--set", 'bake.formats=["bop", "shards"]')
    assert bench.main([*small, "--json", str(file), *SHORT_PICKS]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["part"] for row in rows} == {"setup", *bench.DEFAULT_PARTS}
    assert all(row["value"] >= 0.0 for row in rows)
    printed = capsys.readouterr().out
    for name in ("views, all stages", "picking, steps alone", "perception and planning: fraction of simulation and rendering"):
        assert name in printed


def test_a_stopwatch_sums_calls(device):
    watch, calls = run.Stopwatch(device), []
    owner = SimpleNamespace(work=lambda value, *, factor: calls.append(value * factor) or time.sleep(2e-3))
    with watch.time_method(owner, "work", "name"):
        owner.work(2, factor=3)
        owner.work(4, factor=1)
    owner.work(5, factor=1)
    assert calls == [6, 4, 5]
    assert watch.seconds("name") >= 4e-3
    assert watch.seconds("another") == 0.0


@pytest.mark.parametrize("tool", [rest_report, bench], ids=lambda tool: tool.__name__)
def test_user_errors_are_one_line(tool, capsys):
    assert tool.main(["--device", "cuda:99"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
