"""Real annotated frames as a BOP data set: a frame of a made-up camera, in which everything is known."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from synpick_warp.errors import SynpickError
from tools.reports.real_frames import read_frames, write_data_set

MATRIX = [[200.0, 0.0, 31.5], [0.0, 200.0, 23.5], [0.0, 0.0, 1.0]]


@pytest.fixture
def frames(tmp_path, real_models):
    """A foam brick 0.5 m before the middle of a camera of 64 x 48 px, and a folder of its model."""
    folder, models = tmp_path / "frames", tmp_path / "models"
    folder.mkdir()
    models.mkdir()
    for name in ("models_info.json", "obj_000021.ply", "obj_000021.png"):
        shutil.copy(real_models / name, models)
    label = np.zeros((48, 64), np.uint8)
    label[10:38, 18:46] = 21
    cv2.imwrite(str(folder / "0003_000007-label.png"), label)
    cv2.imwrite(str(folder / "0003_000007-depth.png"), np.where(label, 4750, 0).astype(np.uint16))
    cv2.imwrite(str(folder / "0003_000007-color.png"), np.full((48, 64, 3), (10, 20, 30), np.uint8))
    pose = {"obj_id": 21, "R_model_to_camera": np.eye(3).tolist(), "t_bop_m": [0.0, 0.0, 0.5]}
    world = np.eye(4)[:3].tolist()
    content = {"sequence": "0003", "frame": "000007", "K": MATRIX, "world_to_camera": world, "objects": [pose]}
    (folder / "0003_000007-poses.json").write_text(json.dumps(content))
    return folder, models


def test_a_frame_is_read_in_our_coordinates(frames):
    (frame,) = read_frames(frames[0])
    assert frame.intrinsics[:2, 2].tolist() == [32.0, 24.0]
    assert frame.translations.tolist() == [[0.0, 0.0, 500.0]]
    assert frame.color[0, 0].tolist() == [30, 20, 10]
    assert frame.mask(0).sum() == 28 * 28


def test_the_data_set_has_bops_files(frames, tmp_path):
    out = write_data_set(*frames, tmp_path / "out")
    scene = out / "test" / "000003"
    truth = json.loads((scene / "scene_gt.json").read_text())["7"][0]
    assert (truth["obj_id"], truth["instance_id"], truth["cam_t_m2c"]) == (21, 0, [0.0, 0.0, 500.0])
    silhouette = cv2.imread(str(scene / "mask" / "000007_000000.png"), cv2.IMREAD_UNCHANGED) > 0
    rows, columns = np.nonzero(silhouette)
    # 51 x 77 x 52 mm about the middle of the picture; the near faces are 26 mm nearer.
    assert abs(rows.mean() - 23.5) <= 0.5
    assert abs(columns.mean() - 31.5) <= 0.5
    assert {path.name for path in (out / "models").iterdir()} == {"models_info.json", "obj_000021.ply", "obj_000021.png"}
    info = json.loads((scene / "scene_gt_info.json").read_text())["7"][0]
    assert (info["px_count_all"], info["px_count_visib"]) == (silhouette.sum(), 28 * 28)


def test_bad_folders_are_one_line(frames, tmp_path):
    folder, models = frames
    (tmp_path / "there").mkdir()
    for arguments in ((tmp_path, models, tmp_path / "a"), (folder, models, tmp_path / "there"), (folder, tmp_path, tmp_path / "b")):
        with pytest.raises(SynpickError):
            write_data_set(*arguments)
    (folder / "0003_000007-depth.png").unlink()
    with pytest.raises(SynpickError):
        read_frames(folder)
