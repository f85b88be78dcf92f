"""Cells that cannot be: one line and exit code 2 before anything is simulated, and nothing is written.

Refusals of settings alone are in tests/configs, of bins in tests/scenes/test_bins, of distributions in tests/render/lighting/test_looks.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.stages.sim.simulate import Simulation
from tests.builders import mistake
from tests.worlds.bin_meshes import sloped_bin
from tests.worlds.model_files import exported, put

K = "matrix = [[275.0, 0.0, 163.8], [0.0, 274.6, 117.5], [0.0, 0.0, 1.0]]"
LOOK = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"
CAMERA = f'[[camera]]\nname = "left"\nresolution = [320, 240]\n{K}\n{LOOK}\n'
FILE = f'[[camera]]\nname = "left"\nfile = "FILE"\n{LOOK}\n'
BIN = '[bins]\nkind = "own"\n[[bin]]\nname = "a"\n'
OPENCV = "image_width: 320\nimage_height: 240\ncamera_matrix: [%s]\ndistortion_coefficients: [%s]\n"


def picture() -> bytes:
    return cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))[1].tobytes()


def parts(rest: str = "") -> str:
    return f'[bake]\nmodels = "parts"\n{rest}'


def looks(setting: str) -> str:
    return f"[randomize]\n{setting}\n"


CASES = {
    "singular file": (FILE.replace("FILE", "singular.yaml"), "singular.yaml (OpenCV): the focal lengths are 0 and 0; allowed: above 0"),
    "transposed file": (FILE.replace("FILE", "transposed.yaml"), "transposed.yaml (OpenCV): the camera matrix is written column by column"),
    "file without numbers": (FILE.replace("FILE", "parts/void.stl"), "parts/void.stl is no calibration file"),
    "no file": (FILE.replace("FILE", "gone.yaml"), "gone.yaml; a path in a file of settings is relative to that file"),
    "fold of a file": (FILE.replace("FILE", "folds.yaml"), "camera[0].distortion is "),
    "bin lower than its floor": (BIN + "outer_size = [0.615, 0.373, 0.004]\n", "bin[0].wall is "),
    "corners without room": (BIN + "floor_size = [0.035, 0.319]\n", "bin a: floor_size: a length of 0.035 m is too small"),
    "camera below a mesh's floor": (CAMERA + BIN + 'file = "bin.stl"\nplace = "file"\n',
                                    "in cell.toml; allowed: positions above the bin's floor, z > 1.5"),
    "no weight": (BIN + "weight = 0.0\n", "bin[0].weight is 0.0"),
    "parts in millimetres": (parts(), 'did you mean objects.unit = "'),
    "part larger than the bin": (parts('[objects]\nunit = "mm"\n' + BIN + "outer_size = [0.1, 0.1, 0.05]\nfloor_size = [0.06, 0.06]\n"
                                       "rim_size = [0.07, 0.07]\n"), "long: too large for the bin"),
    "part larger than a compartment": (parts('[objects]\nunit = "mm"\n' + BIN + "compartments = [6, 6]\n"), "long: too large for the bin"),
    "part larger than the budget": (parts('[objects]\nunit = "mm"\n[arrangement]\nvolume = 1e-5\n'), "arrangement.volume is 1e-05 m³"),
    "no parts": ('[bake]\nmodels = "empty"\n', "empty: it contains no models"),
    "texture that is cut": (looks('bin_textures = "cut"'), "cut"),
    "texture that is text": (looks('table_textures = "text"'), "text"),
    "value beyond": (looks("bin_metallic = 2.0"), "randomize.bin_metallic is 2.0"),
    "choice beyond": (looks("lamps = { choice = [0, 9] }"), "randomize.lamps is "),
    "mean beyond": (looks("object_hue = { normal = [400.0, 1.0] }"), "randomize.object_hue is "),
    "colour of two": (looks("bin_color = [0.1, 0.2]"), "randomize.bin_color is "),
    "colour beyond": (looks("bin_color = { uniform = [[0, 0, 0], [1, 1, 255]] }"), "randomize.bin_color is "),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_cell_that_cannot_be_is_one_line(tmp_path, monkeypatch, case):
    def simulate(*arguments, **named):
        raise AssertionError("a tick is simulated")

    for name in ("tick", "tick_parts"):
        monkeypatch.setattr(Simulation, name, simulate)
    monkeypatch.chdir(tmp_path)
    text, said = CASES[case]
    put(Path("cell.toml"), f'preset = "smoke"\n{text}'.encode())
    put(Path("parts/long.stl"), exported(trimesh.creation.box((90.0, 80.0, 70.0)), "stl"))
    put(Path("parts/void.stl"), b"") if case == "file without numbers" else None
    put(Path("bin.stl"), exported(sloped_bin().apply_translation((0.0, 0.0, 1.5)), "stl")) if "bin.stl" in text else None
    put(Path("cut/a.png"), picture()[:3000])
    put(Path("text/a.png"), b"no picture")
    Path("empty").mkdir()
    put(Path("singular.yaml"), (OPENCV % ("0, 0, 160, 0, 0, 120, 0, 0, 1", "0, 0, 0, 0, 0")).encode())
    put(Path("transposed.yaml"), (OPENCV % ("275, 0, 0, 0, 274.6, 0, 163, 117, 1", "0, 0, 0, 0, 0")).encode())
    put(Path("folds.yaml"), (OPENCV % ("275, 0, 163, 0, 274.6, 117, 0, 0, 1", "-2, 0, 0, 0, 0")).encode())
    before = sorted(Path().rglob("*"))
    heard = mistake("bake", "--config", "cell.toml", "--device", "cpu", "--out", "deep/data")
    assert said in heard
    assert sorted(Path().rglob("*")) == before
