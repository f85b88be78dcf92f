"""What is right for the inputs of users that are cameras: calibrations, cells of several cameras, poses."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

import synpick_warp
from synpick_warp.apps.evaluation.models import read_models
from synpick_warp.configs.files.load import load_config
from tests.worlds.cells import bake_cell, cell_config

POSE = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"


def cell(folder: Path, *lines: str) -> Path:
    """File of settings with a camera for each group of lines."""
    path = folder / "cell.toml"
    path.write_text('preset = "smoke"\n' + "".join(f"[[camera]]\n{each}\n{POSE}\n" for each in lines))
    return path


def bakes_with_the_other(case: Path, out: Path) -> None:
    """Boxes around objects are those of their vertices as OpenCV projects them, in the images of both cameras."""
    files = [case, *(path for path in sorted(case.parent.glob("*.yaml")) if path != case)]
    rows = load_config(str(cell(out, *(f'name = "{path.stem}"\nfile = "{path}"' for path in files)))).camera
    bake_cell(out / "set", cell_config(rows))
    data, checked = synpick_warp.open(out / "set"), 0
    models = read_models(out / "set", data.models_info)
    for camera, path in enumerate(files):
        said, view = yaml.safe_load(path.read_text()), data[0].view(0, camera)
        assert view.rgb.shape == (said["image_height"], said["image_width"], 3)
        matrix, lens = (np.array(said[name]["data"]) for name in ("camera_matrix", "distortion_coefficients"))
        for obj_id, pose, (left, top, width, height) in zip(view.object_ids.tolist(), view.object_to_camera, view.boxes, strict=True):
            points = models[obj_id].vertices @ pose[:3, :3].T + pose[:3, 3]
            pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix.reshape(3, 3), lens)[0][:, 0]
            # Pixels are those whose centres lie in the outline, whose corners may be as thin as two pixels.
            margins = np.array([left, top, -left - width, -top - height]) - (*pixels.min(axis=0), *-pixels.max(axis=0))
            assert ((margins > -1e-3) & (margins < 2.0)).all(), margins
            checked += 1
    assert checked >= 4


ROWS = {f"cells/{name}.yaml": bakes_with_the_other for name in ("left", "right")}
