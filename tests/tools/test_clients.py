"""The table of clients, on small data sets of boxes: readers that agree, that disagree, that fail, that are not there. Of readers here
pycocotools alone, as everyone has it."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.testing.box_views import cameras, config
from synpick_warp.testing.exporters import export
from tools.clients import __main__ as tool
from tools.clients import base, environments
from tools.clients.process import NOT_INSTALLED
from tools.clients.reader import CLIENTS
from tools.clients.trajectories import tone_map

CAMERAS = cameras(160, 120)
FRAMES = 2


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = export(BopExporter, tmp_path_factory.mktemp("clients") / "set", config(), (0,), 0, FRAMES, CAMERAS)
    (folder / "episodes.jsonl").write_text(f'{{"episode": 0, "frames": {FRAMES}}}\n')
    return folder


@pytest.fixture
def opened(data, monkeypatch) -> dict[str, np.ndarray]:
    """The clients' data set, opened: masks with visible pixels of its first scene, which can be changed in memory."""
    scene, memory = base.first_scene(data), {}
    assert scene is not None
    for frame in range(FRAMES):
        files = sorted((scene / "mask_visib").glob(f"{frame:06d}_*"))
        masks = np.array([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0 for path in files])
        memory[f"visible_mask {frame}"] = masks[masks.any(axis=(1, 2))]
    monkeypatch.setattr(tool.synpick_warp, "open", lambda folder: {0: None})
    monkeypatch.setitem(CLIENTS, "coco", replace(CLIENTS["coco"], expect=lambda data_set: memory))
    return memory


def test_a_client_that_agrees_and_one_that_disagrees(data, opened, tmp_path, capsys):
    assert tool.main([str(data), "--clients", "coco,xarray_store", "--json", str(tmp_path / "table.json")]) == 0
    first, second = json.loads((tmp_path / "table.json").read_text())["more"]["clients"]
    assert first["version"].startswith("pycocotools 2")
    assert first["agreement"] == f"{FRAMES} values equal"
    assert second["agreement"] == tool.NO_FORMAT
    assert "pycocotools" in capsys.readouterr().out
    opened["visible_mask 1"] = ~opened["visible_mask 1"]
    assert tool.main([str(data), "--clients", "coco"]) == 1
    assert "DIFFERS" in capsys.readouterr().out


def test_a_client_that_fails(tmp_path):
    broken = tmp_path / "train_pbr" / "000000"
    broken.mkdir(parents=True)
    (broken / "scene_camera.json").write_text("{}")
    (tmp_path / "episodes.jsonl").write_text('{"episode": 0, "frames": 1}\n')
    (broken / "scene_gt_coco.json").write_text("{")
    result = tool.run_client("coco", sys.executable, tmp_path, {}, "")
    assert (result.agreement, result.holds) == ("FAILED", False)
    assert result.remarks.startswith("json.decoder.JSONDecodeError")


@pytest.mark.parametrize("name", ["bop_toolkit", "coco"])
def test_a_client_that_is_not_installed_is_no_error(data, opened, name):
    python = sys.executable if name == "bop_toolkit" else str(data / "no-python")
    result = tool.run_client(name, python, data, {}, "")
    assert (result.agreement, result.holds) == (NOT_INSTALLED, True)


@pytest.mark.parametrize("arguments", [(), ("--python", "coco"), ("--python", "word=python3")])
def test_bad_input_is_one_line(tmp_path, capsys, arguments):
    assert tool.main([str(tmp_path), *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_values_are_compared_by_difference_and_pictures_by_psnr():
    ramp = np.linspace(0.0, 1.0, 300).reshape(10, 10, 3)
    assert tool.difference(np.array([1.0, np.nan]), np.array([1.5, np.nan])) == 0.5
    assert tool.difference(np.array([1.0, np.nan]), np.array([1.0, 2.0])) == np.inf
    assert tool.difference(ramp, ramp[1:]) == np.inf
    assert tool.psnr(ramp, ramp + 0.1) == pytest.approx(20.0)
    assert tool.compare(CLIENTS["coco"], {"picture 0": ramp + 0.1}, {"picture 0": ramp}) == ("DIFFERS: picture 0", False)
    assert tool.compare(CLIENTS["coco"], {"a": ramp}, {"b": ramp})[1] is False


def test_blenders_light_goes_through_our_tone_curve():
    """Linear to sRGB up to 0.6; continuous there; below 1 for any light."""
    developed = tone_map(np.array([0.0, 0.18, 0.6, 0.6001, 100.0]))
    np.testing.assert_allclose(developed[:4], [0.0, 0.4614, 0.7977, 0.7978], atol=1e-4)
    assert 0.99 < developed[4] <= 1.0


@pytest.mark.parametrize(("count", "frames"), [(1, [0]), (2, [0, 1]), (221, [0, 110, 220])])
def test_sampled_frames_are_spread_evenly(count, frames):
    assert base.sample_frames(count) == frames


# ---- libraries of reinforcement learning ----


def test_the_table_of_libraries(tmp_path, monkeypatch, capsys):
    """Of one that runs, one that fails and one that is not there; the others are not installed."""
    answers = {
        "gymnasium": "print('gymnasium 1.4.0', '16 steps', sep=chr(9))",
        "skrl": "raise ValueError('spaces differ')",
        "torchrl": "import no_such_library",
    }
    for name, text in answers.items():
        (tmp_path / name).write_text(f"#!{sys.executable}\n{text}\n")
        (tmp_path / name).chmod(0o755)
    given = [f"--python={name}={tmp_path / name}" for name in ("all", *answers)]
    assert environments.main([*given, "--json", str(tmp_path / "table.json")]) == 1
    rows = {row["client"]: row for row in json.loads((tmp_path / "table.json").read_text())["more"]["clients"]}
    assert (rows["gymnasium"]["version"], rows["gymnasium"]["remarks"]) == ("gymnasium 1.4.0", "16 steps")
    assert (rows["skrl"]["agreement"], rows["skrl"]["remarks"]) == ("FAILED", "ValueError: spaces differ")
    missing = [name for name, row in rows.items() if row["agreement"] == NOT_INSTALLED]
    assert missing == ["statistics", "torchrl", "rsl_rl", "stable_baselines3"]
    assert "spaces differ" in capsys.readouterr().out
    assert environments.main(["--python", "keras=python"]) == 2
