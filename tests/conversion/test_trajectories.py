"""Conversions of trajectories that lack something: one line, and nothing written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from synpick_warp.cli.main import EXIT_MISTAKE, main
from synpick_warp.exporters.trajectory.arrays import OBJECTS, STORE
from tests.conversion.test_convert import assets, settings  # noqa: F401  (a fixture)
from tests.harness import scripted_bake

EPISODE = STORE / "episodes" / "000001"
NEEDED = ("time", "object_id", "pose", "fixture_pose", "fixture_visible")
GRIPPER = (*(f"ticks/{name}" for name in ("task", "attached")), "steps/setpoint", "steps")


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    return scripted(tmp_path_factory.mktemp("trajectories") / "source")


def scripted(folder: Path) -> Path:
    scripted_bake.bake(folder, settings("bop", "zarr"))
    return folder


def refusal(source: Path, tmp_path: Path, to: str, capsys) -> str:
    """The line with which a conversion ends that writes nothing."""
    code = main(["convert", str(source), "--to", to, "--out", str(tmp_path / "out"), "--threads", "1"])
    line = capsys.readouterr().err
    assert (code, line.count("\n")) == (EXIT_MISTAKE, 1), line
    assert not (tmp_path / "out").exists()
    return line


@pytest.mark.parametrize("to", ["lerobot", "usd"])
@pytest.mark.parametrize("array", [*(f"ticks/{name}" for name in NEEDED), "ticks", "", *GRIPPER])
def test_an_array_that_is_missing_is_one_line(source, tmp_path, assets, to, array, capsys):  # noqa: F811
    changed = shutil.copytree(source, tmp_path / "source")
    shutil.rmtree(changed / EPISODE / array)
    if to == "usd" and array in GRIPPER:
        assert main(["convert", str(changed), "--to", to, "--out", str(tmp_path / "out"), "--threads", "1"]) == 0
        return
    line = refusal(changed, tmp_path, to, capsys)
    assert "000001" in line
    assert array.rpartition("/")[2] in line


@pytest.mark.parametrize("to", ["lerobot", "usd"])
@pytest.mark.parametrize("change", ["light", "light.map", "light.yaw", "light.exposure", "light.map = 99", "light.yaw = null", "light = 3"])
def test_an_attribute_that_is_missing_or_wrong_is_one_line(source, tmp_path, assets, to, change, capsys):  # noqa: F811
    changed = shutil.copytree(source, tmp_path / "source")
    edit(changed / EPISODE / "zarr.json", change)
    line = refusal(changed, tmp_path, to, capsys)
    assert "light" in line or change.split(" ")[0].rpartition(".")[2] in line


@pytest.mark.parametrize("place", [STORE, EPISODE, STORE / "objects"])
@pytest.mark.parametrize("change", ["", "names", "steps_per_tick", "steps_per_tick = 3", "lights"])
def test_a_group_without_metadata_or_with_others_ends_in_one_line_or_the_same_files(source, tmp_path, assets, place, change, capsys):  # noqa: F811
    """Whatever of the metadata is lost: a line, or a conversion that did not need it."""
    changed = shutil.copytree(source, tmp_path / "source")
    if change:
        edit(changed / place / "zarr.json", change)
    else:
        (changed / place / "zarr.json").unlink()
    code = main(["convert", str(changed), "--to", "lerobot", "--out", str(tmp_path / "out"), "--threads", "1"])
    lines = capsys.readouterr().err
    assert (code, lines.count("\n")) in ((0, 0), (EXIT_MISTAKE, 1)), lines


@pytest.mark.parametrize("name", sorted(OBJECTS.arrays))
def test_an_array_of_the_object_table_that_is_missing_is_one_line(source, tmp_path, assets, name, capsys):  # noqa: F811
    changed = shutil.copytree(source, tmp_path / "source")
    shutil.rmtree(changed / STORE / "objects" / name)
    assert name in refusal(changed, tmp_path, "lerobot", capsys)


@pytest.mark.parametrize("key", ["outcome", "frame", "end_frame", "object_id", "outcome = 3", "frame = -1", "row.arrangement"])
def test_an_attempt_without_what_tasks_are_made_of_is_one_line(source, tmp_path, assets, key, capsys):  # noqa: F811
    changed = shutil.copytree(source, tmp_path / "source")
    path = changed / "manifest" / "000001.json"
    entry = json.loads(path.read_text())
    change(entry["row"] if key.startswith("row.") else entry["attempts"][0], key.removeprefix("row."))
    path.write_text(json.dumps(entry))
    refusal(changed, tmp_path, "lerobot", capsys)


def test_setpoints_that_were_not_baked_are_named(tmp_path, assets, capsys):  # noqa: F811
    """Without recorded setpoints (trajectory.steps = false) actions would repeat the cup's positions."""
    source = scripted(tmp_path / "source")
    shutil.rmtree(source / STORE / "episodes" / "000000" / "steps")
    line = refusal(source, tmp_path, "lerobot", capsys)
    assert "has no steps" in line
    assert "trajectory.steps = true" in line


def edit(path: Path, text: str) -> None:
    content = json.loads(path.read_text())
    change(content["attributes"], text)
    path.write_text(json.dumps(content))


def change(content: dict, text: str) -> None:
    """Remove a key, such as "light.map", or set it, as "light.map = 99" does."""
    key, _, value = text.partition(" = ")
    *parents, last = key.split(".")
    for parent in parents:
        content = content[parent]
    if value:
        content[last] = json.loads(value)
    else:
        content.pop(last, None)
