"""The examples: each runs on a small data set of boxes and passes its own check; without a picked_set it bakes one."""

from __future__ import annotations

import json
import subprocess
import sys
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.files.load import load_config
from synpick_warp.dataset.webdataset import decode_view
from tools.examples import bake_and_show, read_trajectory, train_loop

ROOT = Path(__file__).resolve().parents[2]


def test_bake_and_show(picked_set, tmp_path, capsys):
    bake_and_show.main([str(picked_set), "--out", str(tmp_path / "view.png")])
    assert "2 objects" in capsys.readouterr().out
    drawn, view = cv2.imread(str(tmp_path / "view.png")), synpick_warp.open(picked_set)[0].view(0)
    assert drawn.shape == view.rgb.shape
    changed = (drawn[..., ::-1] != view.rgb).any(axis=-1)
    assert changed[view.masks.any(axis=0)].mean() > 0.9


def test_the_check_of_bake_and_show_fails_on_a_wrong_pose(picked_set):
    data = synpick_warp.open(picked_set)
    view = data[0].view(0)
    view.object_to_camera[:, 2, 3] += 0.2
    with pytest.raises(SystemExit, match="from its pose"):
        bake_and_show.check(view, data.models_info)


def test_train_loop(picked_set):
    """In a process of its own: webdataset leaves files open, which is an error here."""
    command = [sys.executable, "-m", "tools.examples.train_loop", str(picked_set)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.startswith("epoch 0: cross entropy 0.")


def test_samples_of_the_train_loop_are_views(picked_set):
    view = synpick_warp.open(picked_set)[0].view(1)
    names = ("rgb.png", "depth.png", "camera.json", "mask_visib.json")
    with tarfile.open(picked_set / "train_web" / "shard-000000.tar") as shard:
        entries = {name: shard.extractfile(f"000000_000001.{name}").read() for name in names}
    decoded = {name: decode_view(f".{name}", data) for name, data in entries.items()}
    sample = train_loop.prepare(decoded | {"camera.json": json.loads(entries["camera.json"])})
    np.testing.assert_allclose(sample["image"], view.rgb / np.float32(255))
    np.testing.assert_allclose(sample["depth"], view.depth, rtol=1e-6)
    np.testing.assert_array_equal(sample["foreground"], view.masks.any(axis=0))


def test_read_trajectory(picked_set, tmp_path, capsys):
    read_trajectory.main([str(picked_set), "--out", str(tmp_path / "paths.png")])
    printed = capsys.readouterr().out
    episode = synpick_warp.open(picked_set)[0]
    assert printed.count("\nattempt ") + printed.startswith("attempt ") == len(episode.attempts) > 0
    assert f"2 objects, {len(episode)} frames" in printed
    assert (cv2.imread(str(tmp_path / "paths.png")) < 255).any()


@pytest.mark.parametrize("example", [bake_and_show, train_loop, read_trajectory])
def test_a_missing_data_set_is_baked(example, tmp_path, monkeypatch):
    calls = []

    def bake(*arguments: object) -> None:
        calls.append(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(synpick_warp, "bake", bake)
    with pytest.raises(KeyboardInterrupt):
        example.main([str(tmp_path / "set")])
    assert calls == [("smoke", tmp_path / "set", example.SETTINGS)]
    load_config("smoke", example.SETTINGS)
