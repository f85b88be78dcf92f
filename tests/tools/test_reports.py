"""Benchmarks and reports: that they run on small worlds or known data. Measured values are not asserted."""

import json
import shutil
from argparse import Namespace
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.schema import Config
from tests.builders import FEW_STEPS, PICKING, assignments, refusal
from tests.harness.environment import ROOT
from tools.bench import __main__ as bench
from tools.bench import peers, worlds
from tools.compare import __main__ as compare
from tools.compare import pictures
from tools.reports.real.frames import read_frames, render_frames

PICKS = {key: value for key, value in PICKING.items() if key.startswith(("perception.", "pick."))}
SHORT_PICKS = (*FEW_STEPS, *assignments(PICKS | {"pick.speed": 4.0, "pick.lift_speed": 2.0, "settle.rest_displacement": 1e-3}))
"""Options of short picking episodes of one object, with small images for perception."""


def test_inside_is_within_the_rim_from_the_floor_to_the_heap_height():
    tote = Config().tote
    (length, width), rim = tote.rim_size, tote.outer_size[2] - tote.wall
    inside = [[0, 0, 0.01], [0.499 * length, 0, 0.1], [0, 0, rim + 0.09]]
    outside = [[0, 0, -0.001], [0.501 * length, 0, 0.1], [0, -0.501 * width, 0.1], [0, 0, rim + 0.11], [np.nan, 0, 0.1]]
    assert peers.is_inside(BinSizes.of_tote(tote), np.array(inside + outside)).tolist() == [True] * 3 + [False] * 5


@pytest.mark.slow
def test_bench_measures_every_part_of_small_worlds(tmp_path, monkeypatch, capsys):
    for name in ("FALL_TICKS", "SETTLE_TICKS", "STIR_TICKS", "LEAD_TICKS", "PICK_TICKS", "STREAM_BATCHES"):
        monkeypatch.setattr(worlds, name, 1)
    for target in ("run.MIN_REPEATS", "run.BURST", "bakes.LEAD_TICKS"):
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
    for name in ("views, all stages", "picking, steps alone", "perception and planning: fraction of the simulation's time"):
        assert name in printed


@pytest.mark.parametrize(
    ("tool", "arguments", "said"),
    [
        (bench, ["--device", "cuda:99"], "cuda:99"),
        *((pictures, ["--devices", devices], "compare pictures: ") for devices in ("cpu", "cpu,cpu,cpu", "cpu,tpu", "")),
        *((compare, arguments, " is no comparison; ") for arguments in ([], ["dance"])),
        (compare, ["guard", str(ROOT), "/nowhere"], " is no checkout"),
    ],
)
def test_a_mistake_is_one_line(tool, arguments, said, capsys):
    assert tool.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


# ---- photographs ----


MATRIX = [[200.0, 0.0, 31.5], [0.0, 200.0, 23.5], [0.0, 0.0, 1.0]]


@pytest.fixture
def frames(tmp_path):
    """A foam brick 0.5 m before the middle of a camera of 64 x 48 px."""
    folder = tmp_path / "frames"
    folder.mkdir()
    label = np.zeros((48, 64), np.uint8)
    label[10:38, 18:46] = 21
    cv2.imwrite(str(folder / "0003_000007-label.png"), label)
    cv2.imwrite(str(folder / "0003_000007-depth.png"), np.where(label, 4750, 0).astype(np.uint16))
    cv2.imwrite(str(folder / "0003_000007-color.png"), np.full((48, 64, 3), (10, 20, 30), np.uint8))
    pose = {"obj_id": 21, "R_model_to_camera": np.eye(3).tolist(), "t_bop_m": [0.0, 0.0, 0.5]}
    world = np.eye(4)[:3].tolist()
    content = {"sequence": "0003", "frame": "000007", "K": MATRIX, "world_to_camera": world, "objects": [pose]}
    (folder / "0003_000007-poses.json").write_text(json.dumps(content))
    return folder


def test_a_frame_is_read_in_our_coordinates(frames):
    (frame,) = read_frames(frames)
    assert frame.intrinsics[:2, 2].tolist() == [32.0, 24.0]
    assert frame.translations.tolist() == [[0.0, 0.0, 500.0]]
    assert frame.color[0, 0].tolist() == [30, 20, 10]
    assert frame.mask(0).sum() == 28 * 28


def test_bad_folders_are_one_line(frames, tmp_path):
    assert "has no frames" in refusal(read_frames, tmp_path)
    (frames / "0003_000007-depth.png").unlink()
    assert "0003_000007-depth.png" in refusal(read_frames, frames)


def test_a_twin_differs_in_its_objects_alone(frames, tmp_path):
    """A box of 66 x 66 x 50 mm, whose front is 27.8 px wide: it covers the pixels that the photograph labels."""
    trimesh.creation.box((66.0, 66.0, 50.0)).export(tmp_path / "obj_000021.ply")
    (frame,) = read_frames(frames)
    options = Namespace(models=str(tmp_path), lights="", device="cpu", set=["render.coarse_paths=1"])
    empty = replace(frame, object_ids=(), rotations=frame.rotations[:0], translations=frame.translations[:0])
    unchanged, twin = render_frames([empty, frame], options)
    assert unchanged is empty
    np.testing.assert_array_equal(twin.label, frame.label)
    np.testing.assert_array_equal(twin.color[frame.label == 0], frame.color[frame.label == 0])
    assert (twin.color[25, 35] != frame.color[25, 35]).any()
