"""The measuring tools: what they compute, and that they run on small worlds. No number of a measurement is asserted."""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Status, Task, names
from synpick_warp.configs.schema import Config
from synpick_warp.stages.stream import TickReport
from tests.worlds.small_worlds import catalog
from tools.bench import __main__ as bench
from tools.bench import physics as bench_physics
from tools.bench import sensor as bench_sensor
from tools.bench import write as bench_write
from tools.reports import pick as pick_report
from tools.reports import pick_tally
from tools.reports import rest as rest_report

FOLDER = Path(__file__).resolve().parents[2] / "tools"
FEW = (
    "--device",
    "cpu",
    "--set",
    "arrangement.volume=1e-3",
    "--set",
    "arrangement.max_objects=1",
    "--set",
    "physics.substeps=1",
    "--set",
    "physics.steps_per_tick=10",
    "--set",
    "settle.min_time=0.1",
    "--set",
    "settle.rest_ticks=2",
)
"""One object a world, and as few steps as bring it to rest."""
GLANCE = (
    "--set",
    "sight.resolution=[160,90]",
    "--set",
    "sight.contour_points=512",
    "--set",
    "sight.contour_offset=1.5",
    "--set",
    "sight.min_votes=2.0",
    "--set",
    "sight.normal_window=2",
)
"""Small images to choose by."""
DASH = (
    "--set",
    "pick.appear_height=0.2",
    "--set",
    "pick.speed=4.0",
    "--set",
    "pick.near_speed=0.5",
    "--set",
    "pick.lift_height=0.2",
    "--set",
    "pick.lift_speed=2.0",
    "--set",
    "pick.failures=1",
    "--set",
    "settle.rest_shift=1e-3",
)
"""Episodes of picking that are over soon."""


def pile(**changes):
    """Two objects at rest, well within all bounds."""
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


# ---- sequences of picking ----

ROOM = 3
HOME = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0])
"""A pose in the tote."""


def tick_report(*worlds: dict) -> TickReport:
    """What a tick tells of worlds that act, three objects each; keys: status columns, load, `gone` instances, `poses` by instance."""
    status = np.zeros((len(worlds), len(Status)), np.int32)
    entry, pose = np.zeros((len(worlds), ROOM), np.int32), np.tile(HOME, (len(worlds), ROOM, 1))
    acting = {"phase": Phase.ACT, "live": 1, "mode": Mode.PICK, "task": Task.LIFT}
    for world, values in enumerate(worlds):
        for name, value in (acting | values).items():
            if name in names(Status):
                status[world, Status[name.upper()]] = int(value)
        entry[world, list(values.get("gone", ()))] = -1
        for instance, moved in values.get("poses", {}).items():
            pose[world, instance] = moved
    measures = np.array([[values.get("load", 0.0)] for values in worlds], np.float32)
    return TickReport(status, measures, entry, pose.astype(np.float32), *(SimpleNamespace() for _ in range(3)))


def tallied(*ticks: TickReport, modes=("pick",)):
    tally = pick_tally.Tally(Config(), catalog(), modes, 1)
    for now in ticks:
        tally.see(now, {0: (1.5, 2, 3)})
    return tally


PICKED = {"outcome": Outcome.TARGET_PICKED}
OVER = {"phase": Phase.OVER, "ending": Ending.GAVE_UP}


def test_a_sequence_is_counted_frame_by_frame():
    tally = tallied(
        tick_report({"task": Task.LOOK}),
        tick_report({"task": Task.LIFT, "held": 0b110, "caught": 0b110, "load": 7.0}),
        tick_report({**PICKED, "task": Task.LOOK, "caught": 0b110, "hits": 9, "held": 0b100, "gone": [2], "load": 3.0}),
        tick_report({"task": Task.LIFT, "gone": [0, 2], "held": 0b001, "load": 5.0}),
        tick_report({**OVER, "task": Task.LOOK, "gone": [0, 2], "outcome": Outcome.NOTHING_CAUGHT}),
    )
    (found,) = tally.sequences("pick")
    assert (found.frames, found.objects, found.left, found.picked, found.lost) == (5, 3, 1, 1, 1)
    assert found.outcomes == {"TARGET_PICKED": 1, "NOTHING_CAUGHT": 1}
    assert (found.attempts, found.successes) == (2, 1)
    assert found.tasks == {"look": 3, "lift": 2}
    assert (found.hits, found.loads) == ([9], [7.0])
    assert (found.visible_share, found.instances, found.views) == (7.5, 10, 15)
    assert found.ending == "gave_up"
    assert tally.complete()


def test_the_first_sequences_by_number_count_not_the_first_to_end():
    first, second = {"episode": 0}, {"episode": 1}
    ticks = [tick_report(first, second), tick_report(first, second | OVER), tick_report(first, second | {"episode": 2})]
    tally = tallied(*ticks)
    assert tally.sequences("pick") == []
    assert not tally.complete()
    tally = tallied(*ticks, tick_report(first | OVER, second | {"episode": 2}))
    assert [sequence.episode for sequence in tally.sequences("pick")] == [0]
    assert tally.complete()


def test_each_mode_has_its_own_sequences():
    pick, target, move = ({"episode": number, "mode": mode} for number, mode in enumerate((Mode.PICK, Mode.TARGET, Mode.MOVE)))
    ticks = [tick_report(pick, target, move), tick_report(pick | OVER, target, move | OVER)]
    tally = tallied(*ticks, modes=("pick", "target"))
    assert [len(tally.sequences(mode)) for mode in ("pick", "target")] == [1, 0]
    assert not tally.complete()
    rows = {row.name: row.values for row in pick_tally.report(tally)}
    assert rows["begun, but not ended"] == {"pick": 0, "target": 1}


def test_what_is_drawn_again_is_forgotten_and_at_last_given_up():
    failed = {"phase": Phase.OVER, "live": 0, "ending": Ending.SOLVER_OVERFLOW}
    again = [tick_report({}), tick_report(failed), tick_report({"redraw": 1}), tick_report({"redraw": 1} | OVER)]
    tally = tallied(*again)
    assert tally.redrawn == {"solver_overflow": 1}
    assert tally.sequences("pick")[0].frames == 2
    tally = tallied(tick_report({}), tick_report(failed | {"redraw": Config().settle.tries - 1}))
    assert tally.complete()
    assert tally.sequences("pick") == []
    assert {row.name: row.values["pick"] for row in pick_tally.report(tally)}["given up"] == 1


def test_speeds_are_told_apart_by_place():
    """Over a tick of 66 ms: 33 mm in the tote, 66 mm outside, 132 mm on the cup."""
    outside, high = HOME + np.eye(7)[0] * 2.0, HOME + np.eye(7)[2] * 0.5
    still = {"held": 0b100, "poses": {1: outside, 2: high}}
    shift = 0.033 * np.eye(7)[0]
    moved = {"held": 0b100, "poses": {0: HOME + shift, 1: outside - 2 * shift, 2: high + 4 * shift}}
    (found,) = tallied(tick_report(still), tick_report(moved), tick_report(moved | OVER)).sequences("pick")
    assert found.speed == pytest.approx([0.5, 1.0, 2.0], rel=1e-4)
    # What has gone, or belongs to another arrangement, has no speed.
    (found,) = tallied(tick_report(still | {"redraw": 1}), tick_report(moved | OVER | {"gone": [2]})).sequences("pick")
    assert found.speed == [0.0, 0.0, 0.0]


def test_poses_that_are_no_numbers_are_counted():
    wrong = {"poses": {1: HOME * np.nan}}
    tally = tallied(tick_report({}), tick_report(wrong), tick_report(wrong | OVER))
    assert tally.sequences("pick")[0].not_finite == 2
    (row,) = (row for row in pick_tally.report(tally) if row.name == "poses that are no numbers")
    assert row.holds == {"pick": False}


def test_visible_shares_are_of_instances_that_have_pixels():
    pixels = np.array([[[10, 10, 5], [0, 0, 0], [4, 4, 4]], [[0, 0, 0]] * 3])
    shares, instances = pick_tally.visible_shares(pixels)
    assert shares.tolist() == [1.5, 0.0]
    assert instances.tolist() == [2, 0]


@pytest.mark.parametrize(("frames", "holds"), [(458, False), (459, True), (573, True), (687, True), (688, False)])
def test_frames_are_to_be_within_a_fifth_of_the_papers(frames, holds):
    rows = pick_tally.report(tallied(*[tick_report({})] * (frames - 1), tick_report(OVER)))
    (row,) = (row for row in rows if row.name == "frames a sequence")
    assert row.values == {"pick": frames}
    assert row.holds == {"pick": holds}


def test_a_report_without_sequences_holds_nothing():
    rows = {row.name: row for row in pick_tally.report(tallied(modes=("pick", "target")))}
    assert not any(rows["frames a sequence"].holds.values())
    assert all(value is None for value in rows["frames a sequence"].record()["values"].values())


def test_sequences_of_both_modes_are_simulated_and_seen(tmp_path):
    file = tmp_path / "picks.json"
    options = ["--episodes", "1", "--worlds", "2", "--visibility-resolution", "32x18", "--json", str(file), *FEW, *GLANCE, *DASH]
    assert pick_report.main(options) == 1  # Not as many frames as the paper has.
    record = json.loads(file.read_text())
    rows = {row["name"]: row["values"] for row in record["rows"]}
    assert rows["sequences"] == {"pick": 1, "target": 1}
    assert rows["objects at the start"] == {"pick": 1, "target": 1}
    for sequence in record["sequences"]:
        assert sequence["frames"] == sum(sequence["tasks"].values())
        assert sequence["views"] == 3 * sequence["frames"]
        assert sequence["objects"] == sequence["picked"] + sequence["lost"] + sequence["left"]
        assert 0.0 < sequence["visible_share"] <= sequence["instances"] <= sequence["views"]


def test_when_time_is_up_the_report_is_of_what_has_ended(tmp_path, capsys):
    file = tmp_path / "picks.json"
    options = ["--modes", "pick", "--episodes", "1", "--no-visibility", "--max-seconds", "1e-3", "--json", str(file), *FEW, *GLANCE]
    assert pick_report.main(options) == 1
    assert json.loads(file.read_text())["ticks"] == 1
    assert "are over" in capsys.readouterr().out


def test_bench_measures_every_part_of_small_worlds(tmp_path, monkeypatch, capsys):
    for name in ("FALL_TICKS", "SETTLE_TICKS", "STIR_TICKS", "LEAD_TICKS", "PICK_TICKS", "LEAST_REPEATS", "BURST"):
        monkeypatch.setattr(bench_physics, name, 1)
    monkeypatch.setattr(bench_sensor, "BURST", 1)
    for name, value in (("BURST", 1), ("STREAM_BATCHES", 1), ("WRITE_VIEWS", 3), ("BAKE_SPEED", 10.0)):
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(bench_write, "COPIES", 1)
    file = tmp_path / "bench.json"
    small = ("--worlds", "1", "--resolution", "32x18", "--seconds", "0", "--set", 'bake.formats=["bop", "shards"]')
    assert bench.main([*small, "--json", str(file), *FEW, *GLANCE, *DASH]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["part"] for row in rows} == {"setup", *bench.PARTS}
    assert all(row["value"] >= 0.0 for row in rows)
    printed = capsys.readouterr().out
    sights = ("views, all stages", "picking, steps alone", "looks and plans: share of the time with rendering")
    writers = ("bop, 1 process: views", "bop, 1 process: CPU of a view, writers, kernel", "shards, 1 process: cores in use")
    for name in (*sights, *writers, "SensorCamera's time over ours"):
        assert name in printed


def test_a_stopwatch_adds_up_calls(device):
    watch, calls = bench_physics.Stopwatch(device), []
    owner = SimpleNamespace(work=lambda number, *, factor: calls.append(number * factor) or time.sleep(2e-3))
    with watch.around(owner, "work", "name"):
        owner.work(2, factor=3)
        owner.work(4, factor=1)
    owner.work(5, factor=1)
    assert calls == [6, 4, 5]
    assert watch.seconds("name") >= 4e-3
    assert watch.seconds("another") == 0.0


@pytest.mark.parametrize("tool", [rest_report, pick_report, bench], ids=lambda tool: tool.__name__)
def test_mistakes_are_one_line(tool, capsys):
    assert tool.main(["--device", "cuda:99"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "steps", "message"), [((), "", "usage:"), (("folder",), "rest dance", "gpu_run: no such step: dance")]
)
def test_the_gpu_script_is_bash_and_says_what_it_wants(tmp_path, arguments, steps, message):
    command = ["bash", FOLDER / "gpu_run.sh", *(tmp_path / name for name in arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "STEPS": steps})
    assert done.returncode == 2
    assert done.stderr.startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_the_gpu_script_does_what_it_is_told_within_its_time(tmp_path):
    """With a stand-in for Python that says what it was asked for, and fails once."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\ncase "$*" in *reports.rest*) exit 3;; esac\necho "asked: $*"\n')
    python.chmod(0o755)
    variables = {"STEPS": "rest pick", "PYTHON": python, "DATA": tmp_path, "PICK_SETTINGS": "pick.failures=4", "TMPDIR": tmp_path}
    environment = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"} | variables
    done = subprocess.run(["bash", FOLDER / "gpu_run.sh", tmp_path / "out"], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    assert [line.partition(" after")[0] for line in done.stdout.splitlines() if line.startswith("==")] == [
        "== piles at rest",
        "== piles at rest: exit code 3",
        "== picking",
        "== picking: exit code 0",
    ]
    assert "-m tools.reports.pick --device cuda:0 --episodes 64 --set pick.failures=4" in done.stdout
    assert (tmp_path / "out" / "run.log").read_text() == done.stdout
