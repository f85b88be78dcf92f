"""Reports and benchmarks: their statistics and bounds, and that they run on small worlds. Measured values are not asserted."""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Status, Task, column_names
from synpick_warp.configs.schema import Config
from synpick_warp.stages.stream import TickReport
from tests.worlds.small_worlds import catalog
from tools.bench import __main__ as bench
from tools.bench import physics as bench_physics
from tools.figures import read_runs
from tools.reports import pick as pick_report
from tools.reports import pick_tally
from tools.reports import rest as rest_report

FOLDER = Path(__file__).resolve().parents[2] / "tools"
FEW_STEPS = (
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
"""Settings: one object per world, and as few steps as bring it to rest."""
SMALL_IMAGES = (
    "--set",
    "perception.resolution=[160,90]",
    "--set",
    "perception.contour_points=512",
    "--set",
    "perception.contour_offset=1.5",
    "--set",
    "perception.min_votes=2.0",
    "--set",
    "perception.normal_window=2",
)
"""Settings: small images for perception."""
SHORT_EPISODES = (
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
    "settle.rest_displacement=1e-3",
)
"""Settings: short picking episodes."""


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
    return rest_report.Pile(**values | changes)


def violated(results) -> list[str]:
    """Names of the report's rows whose bound is violated."""
    return [row.name for row in rest_report.report(results) if not row.holds]


def test_a_settled_pile_is_within_all_bounds():
    assert violated(rest_report.Results([pile(), pile()])) == []


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
    assert violated(rest_report.Results([pile(**changes)])) == names


def test_without_piles_all_bounds_are_violated():
    assert len(violated(rest_report.Results(given_up=1))) == 6


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
    assert rest_report.is_inside(config, positions).tolist() == [True, False, True, False, False, True, False, False]


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


# ---- picking sequences ----

CAPACITY = 3
IN_TOTE = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0])
"""A pose in the tote."""


def tick_report(*worlds: dict) -> TickReport:
    """Report of a tick of acting worlds with 3 objects each; keys: status columns, peak_force, `removed` instances, `poses` by instance."""
    status = np.zeros((len(worlds), len(Status)), np.int32)
    catalog_index, pose = np.zeros((len(worlds), CAPACITY), np.int32), np.tile(IN_TOTE, (len(worlds), CAPACITY, 1))
    columns = column_names(Status)
    acting = {"phase": Phase.ACT, "live": 1, "mode": Mode.PICK, "task": Task.LIFT}
    for world, values in enumerate(worlds):
        for name, value in (acting | values).items():
            if name not in ("removed", "poses", "peak_force"):
                status[world, columns[name]] = int(value)
        catalog_index[world, list(values.get("removed", ()))] = -1
        for instance, instance_pose in values.get("poses", {}).items():
            pose[world, instance] = instance_pose
    measures = np.array([[values.get("peak_force", 0.0)] for values in worlds], np.float32)
    return TickReport(status, measures, catalog_index, pose.astype(np.float32), *(SimpleNamespace() for _ in range(3)))


def tally_of(*ticks: TickReport, modes=("pick",)):
    tally = pick_tally.Tally(Config(), catalog(), modes, 1)
    for now in ticks:
        tally.add_tick(now, {0: (1.5, 2, 3)})
    return tally


PICKED = {"outcome": Outcome.TARGET_PICKED}
OVER = {"phase": Phase.OVER, "ending": Ending.GAVE_UP}


def test_a_sequence_accumulates_frame_by_frame():
    tally = tally_of(
        tick_report({"task": Task.LOOK}),
        tick_report({"task": Task.LIFT, "attached": 0b110, "engaged": 0b110, "peak_force": 7.0}),
        tick_report({**PICKED, "task": Task.LOOK, "engaged": 0b110, "hits": 9, "attached": 0b100, "removed": [2], "peak_force": 3.0}),
        tick_report({"task": Task.LIFT, "removed": [0, 2], "attached": 0b001, "peak_force": 5.0}),
        tick_report({**OVER, "task": Task.LOOK, "removed": [0, 2], "outcome": Outcome.NOTHING_CAUGHT}),
    )
    (sequence,) = tally.sequences("pick")
    assert (sequence.frames, sequence.objects, sequence.left, sequence.picked, sequence.lost) == (5, 3, 1, 1, 1)
    assert sequence.outcomes == {"TARGET_PICKED": 1, "NOTHING_CAUGHT": 1}
    assert (sequence.attempts, sequence.successes) == (2, 1)
    assert sequence.tasks == {"look": 3, "lift": 2}
    assert (sequence.hits, sequence.peak_forces) == ([9], [7.0])
    assert (sequence.visible_fraction, sequence.instances, sequence.views) == (7.5, 10, 15)
    assert sequence.ending == "gave_up"
    assert tally.complete()


def test_sequences_are_selected_by_episode_index_not_by_end():
    first, second = {"episode": 0}, {"episode": 1}
    ticks = [tick_report(first, second), tick_report(first, second | OVER), tick_report(first, second | {"episode": 2})]
    tally = tally_of(*ticks)
    assert tally.sequences("pick") == []
    assert not tally.complete()
    tally = tally_of(*ticks, tick_report(first | OVER, second | {"episode": 2}))
    assert [sequence.episode for sequence in tally.sequences("pick")] == [0]
    assert tally.complete()


def test_each_mode_has_its_own_sequences():
    pick, target, move = ({"episode": episode, "mode": mode} for episode, mode in enumerate((Mode.PICK, Mode.TARGET, Mode.MOVE)))
    ticks = [tick_report(pick, target, move), tick_report(pick | OVER, target, move | OVER)]
    tally = tally_of(*ticks, modes=("pick", "target"))
    assert [len(tally.sequences(mode)) for mode in ("pick", "target")] == [1, 0]
    assert not tally.complete()
    rows = {row.name: row.values for row in pick_tally.report(tally)}
    assert rows["unfinished"] == {"pick": 0, "target": 1}


def test_failed_arrangements_are_dropped_and_finally_given_up():
    failed = {"phase": Phase.OVER, "live": 0, "ending": Ending.SOLVER_OVERFLOW}
    resampled = [tick_report({}), tick_report(failed), tick_report({"arrangement": 1}), tick_report({"arrangement": 1} | OVER)]
    tally = tally_of(*resampled)
    assert tally.resampled == {"solver_overflow": 1}
    assert tally.sequences("pick")[0].frames == 2
    tally = tally_of(tick_report({}), tick_report(failed | {"arrangement": Config().settle.tries - 1}))
    assert tally.complete()
    assert tally.sequences("pick") == []
    assert {row.name: row.values["pick"] for row in pick_tally.report(tally)}["given up"] == 1


def test_speeds_are_reported_by_place():
    """Over a tick of 66 ms: 33 mm in the tote, 66 mm outside, 132 mm on the cup."""
    outside, high = IN_TOTE + np.eye(7)[0] * 2.0, IN_TOTE + np.eye(7)[2] * 0.5
    still = {"attached": 0b100, "poses": {1: outside, 2: high}}
    displacement = 0.033 * np.eye(7)[0]
    moved = {"attached": 0b100, "poses": {0: IN_TOTE + displacement, 1: outside - 2 * displacement, 2: high + 4 * displacement}}
    (sequence,) = tally_of(tick_report(still), tick_report(moved), tick_report(moved | OVER)).sequences("pick")
    assert sequence.speed == pytest.approx([0.5, 1.0, 2.0], rel=1e-4)
    # Removed objects, and objects of another arrangement, have no speed.
    (sequence,) = tally_of(tick_report(still | {"arrangement": 1}), tick_report(moved | OVER | {"removed": [2]})).sequences("pick")
    assert sequence.speed == [0.0, 0.0, 0.0]


def test_poses_that_are_not_finite_are_counted():
    wrong = {"poses": {1: IN_TOTE * np.nan}}
    tally = tally_of(tick_report({}), tick_report(wrong), tick_report(wrong | OVER))
    assert tally.sequences("pick")[0].not_finite == 2
    (row,) = (row for row in pick_tally.report(tally) if row.name == "poses that are not finite")
    assert row.holds == {"pick": False}


def test_visible_fractions_cover_instances_with_pixels():
    pixels = np.array([[[10, 10, 5], [0, 0, 0], [4, 4, 4]], [[0, 0, 0]] * 3])
    fractions, instances = pick_tally.sum_visibility(pixels)
    assert fractions.tolist() == [1.5, 0.0]
    assert instances.tolist() == [2, 0]


@pytest.mark.parametrize(("frames", "holds"), [(458, False), (459, True), (573, True), (687, True), (688, False)])
def test_frames_are_bounded_by_a_fifth_of_the_papers(frames, holds):
    rows = pick_tally.report(tally_of(*[tick_report({})] * (frames - 1), tick_report(OVER)))
    (row,) = (row for row in rows if row.name == "frames a sequence")
    assert row.values == {"pick": frames}
    assert row.holds == {"pick": holds}


def test_without_sequences_bounds_are_violated():
    rows = {row.name: row for row in pick_tally.report(tally_of(modes=("pick", "target")))}
    assert not any(rows["frames a sequence"].holds.values())
    assert all(value is None for value in rows["frames a sequence"].to_dict()["values"].values())


def test_sequences_of_both_modes_are_simulated_and_rendered(tmp_path):
    file = tmp_path / "picks.json"
    options = [
        "--episodes",
        "1",
        "--worlds",
        "2",
        "--visibility-resolution",
        "32x18",
        "--json",
        str(file),
        *FEW_STEPS,
        *SMALL_IMAGES,
        *SHORT_EPISODES,
    ]
    assert pick_report.main(options) == 1  # Fewer frames than the paper.
    record = json.loads(file.read_text())
    rows = {row["name"]: row["values"] for row in record["rows"]}
    assert rows["sequences"] == {"pick": 1, "target": 1}
    assert rows["objects at the start"] == {"pick": 1, "target": 1}
    for sequence in record["sequences"]:
        assert sequence["frames"] == sum(sequence["tasks"].values())
        assert sequence["views"] == 3 * sequence["frames"]
        assert sequence["objects"] == sequence["picked"] + sequence["lost"] + sequence["left"]
        assert 0.0 < sequence["visible_fraction"] <= sequence["instances"] <= sequence["views"]


def test_at_the_time_limit_ended_sequences_are_reported(tmp_path, capsys):
    file = tmp_path / "picks.json"
    options = [
        "--modes",
        "pick",
        "--episodes",
        "1",
        "--no-visibility",
        "--max-seconds",
        "1e-3",
        "--json",
        str(file),
        *FEW_STEPS,
        *SMALL_IMAGES,
    ]
    assert pick_report.main(options) == 1
    assert json.loads(file.read_text())["ticks"] == 1
    assert "time limit of" in capsys.readouterr().out


@pytest.mark.slow
def test_bench_measures_every_part_of_small_worlds(tmp_path, monkeypatch, capsys):
    for name in ("FALL_TICKS", "SETTLE_TICKS", "STIR_TICKS", "LEAD_TICKS", "PICK_TICKS", "MIN_REPEATS", "BURST"):
        monkeypatch.setattr(bench_physics, name, 1)
    for target in ("write.COPIES", "meter.LEAD_TICKS"):
        monkeypatch.setattr(f"tools.bench.{target}", 1)
    for name, value in (("BURST", 1), ("STREAM_BATCHES", 1), ("WRITE_VIEWS", 3)):
        monkeypatch.setattr(bench, name, value)
    file = tmp_path / "bench.json"
    small = ("--worlds", "1", "--resolution", "32x18", "--seconds", "0", "--set", 'bake.formats=["bop", "shards"]')
    assert bench.main([*small, "--json", str(file), *FEW_STEPS, *SMALL_IMAGES, *SHORT_EPISODES]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["part"] for row in rows} == {"setup", *bench.DEFAULT_PARTS}
    assert all(row["value"] >= 0.0 for row in rows)
    printed = capsys.readouterr().out
    rows_of_stages = ("views, all stages", "picking, steps alone", "perception and planning: fraction of simulation and rendering")
    writers = ("bop, 1 process: views", "bop, 1 process: CPU time per view, writers, kernel", "shards, 1 process: cores in use")
    for name in (*rows_of_stages, *writers):
        assert name in printed


def test_a_stopwatch_sums_calls(device):
    watch, calls = bench_physics.Stopwatch(device), []
    owner = SimpleNamespace(work=lambda value, *, factor: calls.append(value * factor) or time.sleep(2e-3))
    with watch.time_method(owner, "work", "name"):
        owner.work(2, factor=3)
        owner.work(4, factor=1)
    owner.work(5, factor=1)
    assert calls == [6, 4, 5]
    assert watch.seconds("name") >= 4e-3
    assert watch.seconds("another") == 0.0


@pytest.mark.parametrize("tool", [rest_report, pick_report, bench], ids=lambda tool: tool.__name__)
def test_user_errors_are_one_line(tool, capsys):
    assert tool.main(["--device", "cuda:99"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "steps", "message"), [((), "", "usage:"), (("folder",), "rest dance", "gpu_run: no such step: dance")]
)
def test_the_gpu_script_prints_usage_and_unknown_steps(tmp_path, arguments, steps, message):
    command = ["bash", FOLDER / "gpu_run.sh", *(tmp_path / name for name in arguments)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "STEPS": steps})
    assert result.returncode == 2
    assert result.stderr.startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_the_gpu_script_runs_the_given_steps(tmp_path):
    """With a fake Python that prints its arguments and fails for one tool."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\ncase "$*" in *reports.rest*) exit 3;; esac\necho "asked: $*"\n')
    python.chmod(0o755)
    variables = {"STEPS": "rest pick", "PYTHON": python, "DATA": tmp_path, "PICK_SETTINGS": "pick.failures=4", "TMPDIR": tmp_path}
    environment = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"} | variables
    result = subprocess.run(["bash", FOLDER / "gpu_run.sh", tmp_path / "out"], capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 1
    assert [line.partition(" after")[0] for line in result.stdout.splitlines() if line.startswith("==")] == [
        "== piles at rest",
        "== piles at rest: exit code 3",
        "== picking",
        "== picking: exit code 0",
    ]
    assert "-m tools.reports.pick --device cuda:0 --episodes 64 --set pick.failures=4" in result.stdout
    assert (tmp_path / "out" / "run.log").read_text() == result.stdout
