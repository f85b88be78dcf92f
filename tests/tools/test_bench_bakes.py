"""Benchmarks of bakes: their rows, and the process that verifies and deletes episodes. Measured values are not asserted."""

import itertools
import json
import os
import signal
import subprocess
from pathlib import Path
from unittest import mock

import pytest
import warp as wp

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.dataset.commit.manifest import episode_entry
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import write_manifest_entry
from synpick_warp.stages.render.renderer import Renderer
from tests.harness.processes import wait_for
from tests.tools.test_reports import SHORT_PICKS
from tests.worlds.box_sets import episode_content
from tools.bench import __main__ as bench
from tools.bench import bakes, cleaning, run, worlds
from tools.bench.bakes import Usage, measure_usage
from tools.bench.cleaning import CleanedSet, Cleaner, Tally
from tools.bench.run import Bench

TINY = ("--worlds", "2", "--resolution", "32x18", *SHORT_PICKS)
ANY_DEVICE = tuple(part for part in TINY if part not in ("--device", "cpu"))
SHARED = ("train", "deep/shared")


def write_episode(out: Path, episode: int) -> list[Path]:
    """Commit two files of an episode, in folders of its own; returns their paths."""
    names = [Path(f"train/{episode:06d}/rgb/000000.jpg"), Path(f"deep/shared/{episode:06d}.json")]
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(b"content")
    (out / "manifest").mkdir(exist_ok=True)
    write_manifest_entry(out, episode_entry(episode), names, episode_content(episode))
    return [out / name for name in names]


def reading(seconds: float, count: int) -> bakes.Reading:
    return bakes.Reading(seconds, count, 0, Usage(), Usage(), Usage(), Tally(), 0, 0)


def test_a_verified_episode_is_deleted_and_nothing_else(tmp_path):
    ours, others = write_episode(tmp_path, 1), write_episode(tmp_path, 2)
    data_set = CleanedSet(tmp_path, SHARED)
    tally = data_set.clean(1)
    assert (tally.episodes, tally.files, tally.problem) == (1, 2, "")
    assert not any(path.exists() for path in ours)
    assert not (tmp_path / "train/000001").exists()
    assert all(path.exists() for path in others)
    # Shared folders stay when they are empty.
    data_set.clean(2)
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_dir()) == ["deep", "manifest", "shared", "train"]
    assert (tmp_path / "manifest/000001.json").exists()


@pytest.mark.parametrize(("content", "said"), [(b"other", "has changed since it was written"), (None, "is missing")])
def test_a_damaged_episode_stays_and_is_named(tmp_path, content, said):
    image, table = write_episode(tmp_path, 1)
    image.unlink()
    if content:
        image.write_bytes(content)
    tally = CleanedSet(tmp_path, SHARED).clean(1)
    assert str(image) in tally.problem
    assert said in tally.problem
    assert tally.episodes == 0
    assert table.exists()


@pytest.mark.slow
def test_the_processes_follow_a_growing_data_set_until_one_dies(tmp_path):
    files = [file for episode in range(5) for file in write_episode(tmp_path, episode)]
    size = sum(file.stat().st_blocks * 512 for file in files)
    with Cleaner(CleanedSet(tmp_path, SHARED), 2) as cleaner:
        assert len(set(cleaner.pids)) == 2
        wait_for(lambda: cleaner.poll().episodes == 5)
        assert cleaner.poll() == Tally(5, 10, size)
        assert not any(file.exists() for file in files)
        write_episode(tmp_path, 7)
        wait_for(lambda: cleaner.poll().episodes == 6)
        assert not cleaner.poll().problem
        os.kill(cleaner.pids[-1], signal.SIGKILL)
        wait_for(lambda: cleaner.poll().problem)
        assert "a process that verifies episodes was ended by SIGKILL; " in cleaner.poll().problem
        assert cleaner.poll().episodes == 6


def test_a_file_that_cannot_be_deleted_is_a_problem(tmp_path, monkeypatch):
    image, _ = write_episode(tmp_path, 1)
    monkeypatch.setattr(Path, "unlink", mock.Mock(side_effect=PermissionError(13, "Permission denied", str(image))))
    assert CleanedSet(tmp_path, SHARED).clean(1).problem == f"{image} cannot be deleted: Permission denied"


def test_slices_are_between_readings_and_the_rest_is_left_out():
    readings = [reading(seconds, count) for seconds, count in ((0, 0), (1, 5), (2, 20), (3, 21), (4.5, 45), (5, 99))]
    assert bakes.slice_rates(readings, 2.0) == [10.0, 10.0]
    assert bakes.slice_rates(readings[:1], 2.0) == []


def test_several_devices_are_steady_when_all_of_them_are(tmp_path):
    found = bakes.SteadyMeter(1e9, tmp_path, 8.0, 4, wp.get_device("cpu"), devices=2)
    counts = itertools.accumulate([9, 0, 9, 2, 9, 8, *[9] * 6])
    measured = []
    for views in counts:
        found.update(episodes_done=0, episodes=100, worlds_active=8, views=views, views_per_s=0.0, seconds_left=None)
        measured.append(len(found.readings))
    # Both devices deliver in the fifth and sixth tick together; then two ticks of each lead in.
    assert measured == [0] * 9 + [1, 2, 3]
    row = {row.name: row.value for row in bakes.summarize_rates("view", found)}
    assert row["views to disk"] * row["a tick"] == pytest.approx(1e3 * 18)


def test_descendants_of_the_benchmark_are_counted_and_other_processes_are_not():
    child = subprocess.Popen(["sh", "-c", "sleep 60 & echo $!; wait"], stdout=subprocess.PIPE, text=True)
    try:
        grandchild = int(child.stdout.readline())
        usages = measure_usage()
        assert {os.getpid(), child.pid, grandchild} <= usages.keys()
        assert os.getppid() not in usages
        own = usages[os.getpid()]
        assert own.resident > own.anonymous > 0
    finally:
        os.kill(grandchild, signal.SIGKILL)
        child.wait()
        child.stdout.close()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seconds", "inf"], "inf is out of range; allowed: finite numbers from 0 on"),
        (["--seconds", "nan"], "nan is out of range"),
        (["--seconds", "-1"], "-1 is out of range"),
        (["--json", "/nowhere/x.json"], "there is no folder /nowhere"),
        (["--json", "/tmp"], "/tmp is a folder"),
        (["--compare", "isaac"], "no such peer: isaac; allowed: mujoco-warp, mujoco, sensor-camera"),
        (["--parts", "render", "--devices", "cpu,cpu"], "--devices needs the part steady, the only one that uses several"),
        (["--parts", "steady", "--devices", "cpu,cpu"], "--device and --devices are both given"),
    ],
)
def test_what_would_be_lost_or_ignored_is_refused_at_once(capsys, arguments, said):
    with pytest.raises(SystemExit, match="2"):
        bench.main([*TINY, *arguments])
    assert said in capsys.readouterr().err.splitlines()[-1]


def steady(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code and last line of a measurement."""
    code = bench.main([*arguments, "--parts", "steady", "--seconds", "60"])
    return code, capsys.readouterr().err.splitlines()[-1]


def test_devices_that_do_not_exist_end_the_benchmark_with_one_line(capsys):
    code, line = steady(capsys, *ANY_DEVICE, "--devices", "cuda:98,cuda:99")
    assert (code, "cuda:98" in line) == (2, True)


@pytest.mark.slow
def test_ctrl_c_ends_the_benchmark_with_one_line(monkeypatch, capsys):
    monkeypatch.setattr(bakes.SteadyMeter, "update", lambda *_, **counts: os.kill(os.getpid(), signal.SIGINT))
    assert steady(capsys, *TINY) == (130, "bench: interrupted")


def bench_rows(folder: Path, *arguments: str) -> dict[str, float]:
    """Run the benchmark of tiny worlds; values by the names of its rows, in order."""
    assert bench.main([*TINY, *arguments, "--json", str(folder / "bench.json")]) == 0
    return {row["name"]: row["value"] for row in json.loads((folder / "bench.json").read_text())["rows"]}


@pytest.mark.slow
def test_a_steady_bake_verifies_what_it_writes(tmp_path, monkeypatch):
    monkeypatch.setattr(bakes, "SLICE_SECONDS", 1.0)
    rows = bench_rows(tmp_path, "--parts", "steady", "--seconds", "3")
    assert rows["errors found in them"] == 0
    assert rows["views to disk, slowest 1 s"] <= rows["views to disk, fastest 1 s"]
    assert rows["resident memory of all writers, shared memory in each, at the end"] > 0.0
    assert rows["memory of all writers without shared memory, at the end"] > 0.0
    assert rows["CPU time of a view, verification and deletion"] >= 0.0


def test_damage_is_raised_when_the_bake_has_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(Cleaner, "poll", lambda self: Tally(problem="damaged"))
    with pytest.raises(DatasetError, match="damaged"), cleaning.clean_up_behind(DataLayout.of(bench.Config()), tmp_path):
        pass


@pytest.mark.slow
def test_trajectories_are_baked_without_rendering_views(tmp_path, monkeypatch):
    rendered = mock.Mock(side_effect=AssertionError("a view was rendered"))
    monkeypatch.setattr(Renderer, "render", rendered)
    rows = bench_rows(tmp_path, "--parts", "trajectories", "--seconds", "1")
    assert rows["worlds"] == 2
    assert 0.0 < rows["worlds with a frame in a tick"] <= 100.0
    assert rows["world-steps"] > 0.0
    assert next(value for name, value in rows.items() if name.startswith("episodes, if of ")) > 0.0


# ---- growth ----


def test_growth_by_instances_has_rows_of_each_number(tmp_path, monkeypatch):
    for module, name in ((worlds, "DROP_TICKS"), (worlds, "REST_TICKS"), (run, "BURST"), (run, "MIN_REPEATS")):
        monkeypatch.setattr(module, name, 1)
    rows = bench_rows(tmp_path, "--parts", "growth", "--instances", "2,40", "--seconds", "0", "--set", "physics.steps_per_tick=1")
    for number in (2, 40):
        name = f"{number} instances"
        for state in ("landing", "at rest"):
            assert rows[f"{name}, {state}: part-steps"] == pytest.approx(number * rows[f"{name}, {state}: world-steps"])
        assert rows[f"{name}: worlds without overflow"] == 100.0
    assert rows["40 instances: memory planned for it, at least"] > rows["2 instances: memory planned for it, at least"]


def test_each_replacement_of_newton_is_left_out_once(monkeypatch):
    def left_out() -> int:
        """Number whose bits are the parts that are Newton's own."""
        return sum(2**bit for bit, (name, own) in enumerate(worlds.NEWTONS_OWN.values()) if getattr(worlds.physics, name) is own)

    config = bench.Config().with_values({"bake.worlds": 4})
    steps = worlds.TICKS * config.physics.steps_per_tick * config.bake.worlds
    monkeypatch.setattr(worlds, "load_catalog", lambda config: None)
    monkeypatch.setattr(worlds, "Simulation", lambda *given: given)
    monkeypatch.setattr(worlds, "_time_stirring", lambda simulation: steps / (1.0 + left_out()))
    assert [row.value - 1.0 for row in worlds.measure_patches(Bench(config, 0.0))] == pytest.approx([0, 1, 2, 4, 7, 0])
