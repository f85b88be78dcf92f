"""A bake of a camera with a lens, as it is and rectified: files, cards, and pictures against rays in float64."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.worlds.cells import SIDE, bake_cell, camera_matrix, cell_config, make_camera
from tools.checks.dataset import check

MATRIX = camera_matrix(82.5, 82.38, 49.14, 35.25)
CAMERAS = make_camera("bent", **SIDE, matrix=MATRIX, distortion=[-0.3, 0.08, 0.0005, -0.0003]), make_camera("flat", fov=40.0)
CARDS = ("dataset_info.md", "README.md")


@pytest.mark.parametrize("rectified", [False, True])
def test_a_rectified_set_is_that_of_a_pinhole_with_the_same_matrix(tmp_path, rectified):
    bake_cell(tmp_path / "set", cell_config(CAMERAS, **{"bop.rectified": rectified, "bake.formats": ["bop", "shards"]}))
    bent, flat = (json.loads((tmp_path / f"set/train/{scene:06d}/scene_camera.json").read_text())["0"] for scene in (0, 1))
    assert bent["cam_K"] == np.ravel(MATRIX).tolist()
    assert (bent.get("cam_dist"), flat.get("cam_dist")) == (None if rectified else [-0.3, 0.08, 0.0005, -0.0003], None)
    assert ("cam_dist" in (tmp_path / "set/camera_bent.json").read_text()) is not rectified
    assert all(line.holds for line in vars(check(tmp_path / "set", 4)).values())
    for card in CARDS:
        lines = (tmp_path / "set" / card).read_text().splitlines()
        (first,) = (lines[index + 2] for index, line in enumerate(lines) if line.startswith("# "))
        assert first.startswith("**Pictures are rectified**" if rectified else "**Pictures are distorted** by the lens of bent:")
