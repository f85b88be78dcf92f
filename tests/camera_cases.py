"""What is right for the inputs of users that are cameras: calibrations, cells of several cameras, poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml

import synpick_warp
from synpick_warp.apps.evaluation.models import read_models
from synpick_warp.configs.calibration.files import Calibration, read_calibration
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.cameras import make_cameras
from tests.builders import mistake
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


def is_read(expected: Calibration) -> Callable[[Path, Path], None]:
    """A calibration is read, and a camera's row has its numbers."""

    def check(case: Path, out: Path) -> None:
        assert read_calibration(case) == expected
        resolution = "" if expected.width else "resolution = [320, 240]\n"
        (row,) = load_config(str(cell(out, f'{resolution}file = "{case}"'))).camera
        assert (row.resolution, row.matrix[0][0], row.distortion or ()) == ((320, 240), expected.fx, expected.distortion)

    return check


def is_refused(*words: str) -> Callable[[Path, Path], None]:
    """One line has these words, from a cell of a calibration and from new-cell, and nothing is written."""

    def check(case: Path, out: Path) -> None:
        settings = cell(out, f'file = "{case}"')
        for command in (("bake", "--config", settings, "--out"), ("new-cell", "--calibration", case, "--bin", "600x400x220mm")):
            said = mistake(*command, out / "made")
            assert [word for word in words if word in said] == [*words], said
        assert [*out.iterdir()] == [settings]

    return check


def needs_a_size(case: Path, out: Path) -> None:
    """The file of a cell lies where the cell says; it says no size."""
    settings = out / "a" / case.name
    for path in (settings, out / "in" / "cal" / case.stem):
        path.parent.mkdir(parents=True)
        path.write_bytes((case.parent / path.name).read_bytes())
    said = mistake("bake", "--config", settings, "--out", out / "made")
    assert "camera[0].file does not say the image's size in " in said
    assert "set camera[0].resolution" in said


def looks_away(case: Path, out: Path) -> None:
    """The line says how the camera would see the bin, and so it does."""
    said = mistake("bake", "--config", case, "--out", out / "made")
    assert (
        'it looks away from the tote, and would see it with columns 2 and 3 negated: set axes = "opengl" if its axes are OpenGL\'s' in said
    )
    (out / "gl.toml").write_text(case.read_text().replace("pose = {", 'pose = { axes = "opengl",'))
    (camera,) = make_cameras(load_config(str(out / "gl.toml")).rig)
    np.testing.assert_array_equal(camera.rotation, np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(camera.center, [0.0, 0.0, 1.2])


ROWS = {f"cells/{name}.yaml": bakes_with_the_other for name in ("left", "right")} | {
    "calibrations/D_1e308.yaml": is_refused("D_1e308.yaml", "above 1e+06"),
    "calibrations/bop_cam_dist_model_weird_132.json": is_refused('its distortion model is "weird"; allowed: pinhole, fisheye'),
    "calibrations/cam_K.txt": is_read(Calibration(0, 0, 250.0, 250.0, 160.5, 120.5)),
    "calibrations/cam_K.txt.toml": needs_a_size,
    "calibrations/ros.ini": is_read(Calibration(320, 240, 250.0, 250.0, 160.5, 120.5, distortion=(-0.1, 0.05, 0.0, 0.0, 0.0))),
    "calibrations/ros_rational_cols5.yaml": is_read(
        Calibration(320, 240, 250.0, 250.0, 160.5, 120.5, distortion=(0.19, -0.018, -0.0006, 0.00005, -0.0002, 0.54, -0.028, 0.0))
    ),
    "settings/posegl.toml": looks_away,
}
