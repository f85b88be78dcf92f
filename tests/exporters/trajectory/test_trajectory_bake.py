"""Bake in zarr format: recorded trajectories obey the laws of motion, and bytes depend neither on worlds nor on the lead of physics."""

from __future__ import annotations

import json
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr

import synpick_warp
from synpick_warp.configs.schema import Config
from synpick_warp.stages import ticks
from synpick_warp.stages.stream import FrameStream
from tests.builders import PICKING, bake_boxes, boxes, once
from tests.harness.exporter_contract import digests
from tests.harness.memory_tables import device_arrays
from tests.worlds.small_worlds import settings

TOOL = "tools.checks.trajectory"


MIXED = PICKING | {
    "bake.formats": ["zarr"],
    "bake.mode": "mixed",
    "bake.episodes": 3,
    "cameras.resolution": [32, 18],
    "physics.iterations": 8,
}
"""Settings of a mixed bake that takes some seconds and includes an episode of picking."""


@pytest.fixture(scope="module")
def mixed() -> Config:
    return settings(**MIXED)


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """A finished bake of boxes; beside it the same with another number of worlds, and with physics ahead."""

    def make(folder: Path) -> None:
        with boxes() as patch:
            # No format needs images.
            patch.setattr(FrameStream, "render", lambda *_: pytest.fail("views were rendered"))
            bake_boxes(folder, MIXED)
            patch.setattr(ticks, "queue_lead", lambda *_: 5)
            bake_boxes(folder.with_name("again"), MIXED | {"bake.worlds": 3})

    return once(tmp_path_factory, "mixed", make)[0]


def check(monkeypatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", [TOOL, *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(TOOL, run_name="__main__")
    return ended.value.code


def test_bytes_depend_neither_on_the_number_of_worlds_nor_on_the_lead_of_physics(out):
    assert digests(out / "trajectory.zarr") == digests(out.with_name("again") / "trajectory.zarr")


def test_the_laws_of_motion_hold(out, monkeypatch, capsys):
    assert check(monkeypatch, out) == 0
    assert "VIOLATED" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("array", "what"),
    [
        ("steps/velocity", "change of momentum"),
        ("steps/contact_force", "contacts of all objects against their weight"),
        ("steps/pose", "last step against frame"),
        ("steps/setpoint", "gripper: force against its law"),
        ("steps/seal_force", "peak force of a tick"),
        ("ticks/pose", "speed, by displacement over a tick"),
        ("ticks/pose", "poses that are not finite"),
    ],
)
def test_corrupted_arrays_violate_the_laws_of_motion(out, tmp_path, monkeypatch, capsys, array, what):
    picking = next(episode for episode in synpick_warp.open(out).values() if episode.attributes["mode"] != "move")
    shutil.copytree(out, tmp_path / "set")
    one = zarr.open_array(tmp_path / "set" / f"trajectory.zarr/episodes/{picking.number:06d}" / array, mode="r+")
    values = 1.2 * one[:]
    values[1::2] += 0.02 if array.startswith("steps") else 0.5
    if array.startswith("ticks"):
        values[0] = np.nan
    one[:] = values
    assert check(monkeypatch, tmp_path / "set") == 1
    assert any("VIOLATED" in line and what in line for line in capsys.readouterr().out.splitlines())


def test_a_folder_without_trajectories_cannot_be_checked(tmp_path, monkeypatch, capsys):
    assert check(monkeypatch, tmp_path) == 2
    assert "has no trajectories" in capsys.readouterr().err
    assert check(monkeypatch, tmp_path, "--episodes", 0) == 2


def test_what_is_opened_is_what_was_baked(out, mixed):
    data = synpick_warp.open(out)
    assert data.config == mixed
    lines = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    for row, episode in zip(lines, data.values(), strict=True):
        known = {name: value for name, value in row.items() if name != "checksum"}
        assert {name: episode.attributes[name] for name in known} == known
    attempts = [json.loads(line) for line in (out / "attempts.jsonl").read_text().splitlines()]
    assert [attempt for episode in data.values() for attempt in episode.attempts] == attempts
    assert any(attempt["outcome"] == "target_picked" for attempt in attempts)
    for row, episode in zip(lines, data.values(), strict=True):
        there = episode.ticks["object_id"][:] >= 0
        assert (there[0].sum(), there[-1].sum()) == (row["objects"], row["left"])
        assert episode.steps["time"].shape == (16 * row["frames"],)
        obj_ids = episode.arrangement["object_id"][:]
        np.testing.assert_allclose(episode.arrangement["mass"][:], [data.objects[obj_id - 1].mass for obj_id in obj_ids])


def test_the_memory_table_counts_recorded_arrays(mixed):
    """One record; none for formats that ask for none."""
    mixed = replace(mixed, bake=replace(mixed.bake, device="cpu"))  # A GPU gets at least eight worlds.
    rows = [row for row in device_arrays(mixed) if row[0] == "StepArrays.pose"]
    assert rows == [("StepArrays.pose", (1, 16, 4), "m", 16 * 4 * 28)]
    without = replace(mixed, bake=replace(mixed.bake, formats=("bop",)))
    assert not any(row[0].startswith("StepArrays") for row in device_arrays(without))
