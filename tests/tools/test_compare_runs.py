"""Comparison of data sets: the first difference is reported by file, and by key, pixel, index or line in it."""

from __future__ import annotations

import io
import json
import operator
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr
from pxr import Usd, UsdGeom

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from tools.compare import runs as tool


@pytest.fixture
def runs(tmp_path) -> tuple[Path, Path]:
    """Two equal folders with a file of every type."""
    first, second = tmp_path / "a", tmp_path / "b"
    scene = first / "train" / "000004"
    (scene / "depth").mkdir(parents=True)
    (first / "usd").mkdir()
    (first / "manifest").mkdir()
    cv2.imwrite(str(scene / "depth" / "000002.png"), np.arange(48, dtype=np.uint16).reshape(6, 8))
    (scene / "scene_gt.json").write_text(json.dumps({"0": [{"obj_id": 3, "cam_t_m2c": [1.0, 2.0, 3.0]}]}))
    (first / "episodes.jsonl").write_text('{"frames": 7}\n{"frames": 8}\n')
    (first / "manifest" / "000001.sha256").write_text("00  a\n11  b\n")
    (first / "config.toml").write_text(config_to_toml(load_config("smoke", {})))
    array = zarr.create_array(str(first / "trajectory.zarr" / "episodes" / "000001" / "pose"), shape=(4, 3), dtype="f4", chunks=(4, 3))
    array[...] = np.arange(12).reshape(4, 3)
    with tarfile.open(first / "shard-000000.tar", "w") as file:
        add(file, "000001.gt.json", b"[1, 2]")
    stage = Usd.Stage.CreateNew(str(first / "usd" / "000001.usdc"))
    UsdGeom.Sphere.Define(stage, "/Ball").GetRadiusAttr().Set(2.0)
    stage.Save()
    shutil.copytree(first, second)
    return first, second


def add(file: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(data)
    file.addfile(member, io.BytesIO(data))


def edit_image(path: Path) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[3, 5] += 4
    image[4, 1] += 9
    cv2.imwrite(str(path), image)


def edit_shard(path: Path) -> None:
    with tarfile.open(path, "w") as file:
        add(file, "000001.gt.json", b"[1, 4]")


def edit_usd(path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Sphere(stage.GetPrimAtPath("/Ball")).GetRadiusAttr().Set(3.0)
    stage.Save()


def text(old: str, new: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(path.read_text().replace(old, new))


IMAGE, STAGE, ARRAY = "train/000004/depth/000002.png", "usd/000001.usdc", "trajectory.zarr/episodes/000001/pose"
OTHER = {"bake.worlds": 9, "bake.seed": 5}
CASES = [
    (IMAGE, edit_image, ": row 3, column 5: 29 and 33; 2 of 48 values, by up to 9", "train/*/depth/*.png", 9.0),
    ("train/000004/scene_gt.json", text("2.0", "2.5"), ": 0[0].cam_t_m2c[1]: 2.0 and 2.5", "train/*/scene_gt.json", 0.5),
    ("episodes.jsonl", text("8", "9"), ": [1].frames: 8 and 9", "episodes.jsonl", 1.0),
    ("manifest/000001.sha256", text("11", "12"), ": line 2: 11  b and 12  b", "manifest/*.sha256", None),
    (
        ARRAY,
        lambda path: operator.setitem(zarr.open_array(path, mode="r+"), (2, 1), 7.25),
        "/c/0/0: axis 0 2, axis 1 1: 7.0 and 7.25; 1 of 12 values, by up to 0.25",
        "trajectory.zarr/episodes/*/pose/c/0",
        0.25,
    ),
    ("shard-000000.tar", edit_shard, ": 000001.gt.json: [1]: 2 and 4", "shard-*.tar", 2.0),
    (STAGE, edit_usd, ": line 5 as text: double radius = 2 and double radius = 3", "usd/*.usdc", None),
    ("config.toml", lambda path: path.write_text(config_to_toml(load_config("smoke", OTHER))), ": bake.seed: 0 and 5", "config.toml", 5.0),
]


def test_equal_folders(runs, capsys):
    assert tool.main([str(path) for path in runs]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no difference"


@pytest.mark.parametrize(("name", "edit", "message", "layer", "largest"), CASES, ids=[name for name, *_ in CASES])
def test_the_first_difference_and_its_layer_are_reported(runs, capsys, name, edit, message, layer, largest):
    edit(runs[1] / name)
    assert tool.main([str(path) for path in runs]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"first difference: {name}{message}"
    (row,) = (line.split() for line in lines if line.startswith(layer + " "))
    assert row[1:] == ["1", "1", *(["not", "numeric"] if largest is None else [f"{largest:g}"])]
    assert sum(line.split()[2] == "1" for line in lines[1:-1]) == 1


def test_settings_are_compared_first(runs):
    for name, edit, *_ in CASES:
        edit(runs[1] / name)
    _, message = tool.compare(*runs)
    assert message == "config.toml: bake.seed: 0 and 5"


def test_settings_without_effect_on_files_are_ignored(runs):
    (runs[1] / "config.toml").write_text(config_to_toml(load_config("smoke", {"bake.worlds": 9, "bake.writers": 3})))
    assert tool.compare(*runs)[1] == ""


def test_missing_files_and_folders(runs, tmp_path, capsys):
    (runs[1] / IMAGE).unlink()
    assert tool.compare(*runs)[1] == tool.compare(*runs[::-1])[1] == f"{IMAGE}: only in {runs[0]}"
    (tmp_path / "empty").mkdir()
    for name in ("none", "empty"):
        assert tool.main([str(runs[0]), str(tmp_path / name)]) == 2
        assert name in capsys.readouterr().err
