"""Inputs of a bake that cannot be used: one line and exit code 2 before anything is simulated, and nothing is written.

A case or two of each reader: all others stand beside the reader, in tests/configs, tests/scenes and tests/render/lighting/test_looks.
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
from tests.worlds.model_files import OBJ, exported, put

LOOK = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"
CAMERA = f'[[camera]]\nname = "left"\nresolution = [320, 240]\nfov = 60.0\n{LOOK}\n'
FILE = f'[[camera]]\nname = "left"\nfile = "FILE"\n{LOOK}\n'
BIN = '[bins]\nkind = "own"\n[[bin]]\nname = "a"\n'
PARTS = '[bake]\nmodels = "parts"\n'
IN_MM = PARTS + '[objects]\nunit = "mm"\n'
LIGHTS = '[bake]\nlights = "lights"\n'
TRANSPOSED = "image_width: 320\nimage_height: 240\ncamera_matrix: [275, 0, 0, 0, 274.6, 0, 163, 117, 1]\n"
ROW = '[[object_rows]]\nid = 1\nname = "long"\ndiameter = 0.14\nmass = 0\n'


def looks(setting: str) -> str:
    return f"[randomize]\n{setting}\n"


CASES = {
    "transposed file": (FILE.replace("FILE", "transposed.yaml"), "transposed.yaml (OpenCV): the camera matrix is written column by column"),
    "no file": (FILE.replace("FILE", "gone.yaml"), "gone.yaml; a path in a file of settings is relative to that file"),
    "bin lower than its floor": (BIN + "outer_size = [0.615, 0.373, 0.004]\n", "bin[0].wall is "),
    "corners without room": (BIN + "floor_size = [0.035, 0.319]\n", "bin a: floor_size: a length of 0.035 m is too small"),
    "camera below a mesh's floor": (
        CAMERA + BIN + 'file = "bin.stl"\nplace = "file"\n',
        "in cell.toml; allowed: positions above the bin's floor, z > 1.5",
    ),
    "parts in millimetres": (PARTS, 'did you mean objects.unit = "'),
    "part larger than a compartment": (IN_MM + BIN + "compartments = [6, 6]\n", "long: too large for the bin"),
    "part larger than the budget": (IN_MM + "[arrangement]\nvolume = 1e-5\n", "arrangement.volume is 1e-05 m³, but the smallest object, "),
    "part without mass": (IN_MM + ROW, "object_rows[0].mass is 0 in cell.toml; "),
    "no parts": ('[bake]\nmodels = "empty"\n', "empty: it contains no models; "),
    "texture of a part that is cut": ('[bake]\nmodels = "skin"\n', "skin/t.png: not readable as an image ("),
    "light that is not finite": (LIGHTS, "lights/a.hdr has radiance that is infinite or not a number"),
    "no textures": (looks('bin_textures = "missing"'), "missing cannot be read"),
    "empty textures": (looks('table_textures = "empty"'), "empty has 0 images"),
    "damaged textures": (
        looks('background_textures = "cut"') + "[render]\ntable_size = [1, 1]\n",
        "randomize.background_textures: none of the 2 images of",
    ),
    "a damaged texture": (looks('table_textures = "half"') + "[objects]\nstrict = true\n", "half/b.jpg"),
    "background without floor": (looks('background_textures = "half"'), "render.table_size"),
    "value beyond": (looks("bin_metallic = 2.0"), "randomize.bin_metallic is 2.0"),
    "choice beyond": (looks("lamps = { choice = [0, 9] }"), "randomize.lamps is "),
    "mean beyond": (looks("object_hue = { normal = [400.0, 1.0] }"), "randomize.object_hue is "),
    "colour of two": (looks("bin_color = [0.1, 0.2]"), "randomize.bin_color is "),
    "colour beyond": (looks("bin_color = { uniform = [[0, 0, 0], [1, 1, 255]] }"), "randomize.bin_color is "),
}


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_baked_is_one_line(tmp_path, monkeypatch, case):
    for name in ("tick", "tick_parts"):
        monkeypatch.setattr(Simulation, name, lambda *_, **__: pytest.fail("a tick is simulated"))
    monkeypatch.chdir(tmp_path)
    text, said = CASES[case]
    picture = cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))[1].tobytes()
    radiance = np.full((8, 16, 3), [[[0.5, np.inf, 0.5]]], np.float32)
    files = {
        "cell.toml": f'preset = "smoke"\n{text}',
        "transposed.yaml": TRANSPOSED,
        "bin.stl": exported(sloped_bin().apply_translation((0.0, 0.0, 1.5)), "stl"),
        "parts/long.stl": exported(trimesh.creation.box((90.0, 80.0, 70.0)), "stl"),
        "skin/a.obj": OBJ,
        "skin/a.mtl": "newmtl skin\nmap_Kd t.png\n",
        "skin/t.png": picture[:3000],
        "cut/a.png": picture[:3000],
        "cut/b.webp": b"",
        "half/a.png": picture,
        "half/b.jpg": picture[:40],
        "lights/a.hdr": cv2.imencode(".tiff", radiance)[1].tobytes(),  # Unlike a radiance map, it can hold any number.
    }
    for name, content in files.items():
        put(Path(name), content)
    Path("empty").mkdir()
    before = sorted(Path().rglob("*"))
    assert said in mistake("bake", "--config", "cell.toml", "--device", "cpu", "--mode", "move", "--out", "deep/data")
    assert sorted(Path().rglob("*")) == before
