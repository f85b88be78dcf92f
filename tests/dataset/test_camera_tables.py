"""A bake of cameras of two sizes, with matrix and field of view, in every format."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.load import load_config
from synpick_warp.configs.schema import FORMATS
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.system.progress import SilentProgress
from tests.builders import STIRRING, boxes, once, run
from tests.worlds.small_worlds import settings

CELL = """preset = "smoke"
[[camera]]
name = "left"
resolution = [96, 72]
matrix = [[82.5, 0.0, 49.14], [0.0, 82.38, 35.25], [0.0, 0.0, 1.0]]
pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }
[[camera]]
name = "top"
resolution = [64, 48]
fov = 40.0
pose = { position = [0.0, 0.0, 1.2], look_at = [0.0, 0.0, 0.0], up = [0.0, 1.0, 0.0] }
"""
SIZES = [(96, 72), (64, 48)]


def bake(out, layout: str, formats: tuple[str, ...]) -> None:
    out.parent.mkdir(exist_ok=True)
    (out.parent / "cell.toml").write_text(CELL)
    rows = load_config(str(out.parent / "cell.toml")).camera
    config = settings(**STIRRING | {"bake.formats": list(formats), "bop.layout": layout})
    with boxes():
        run_bake(replace(config, camera=rows), out, SilentProgress())


@pytest.fixture(scope="module", params=["classic", "multisensor"])
def cell(tmp_path_factory, request):
    formats = FORMATS if request.param == "classic" else ("bop", "usd")
    return once(tmp_path_factory, f"cell-{request.param}", lambda out: bake(out, request.param, formats))[0]


def test_every_view_has_its_cameras_size_and_matrix(cell):
    data = synpick_warp.open(cell)
    assert [tuple(camera.resolution) for camera in data.cameras] == SIZES
    seen = set()
    for view in data.views():
        width, height = SIZES[view.camera]
        assert (view.rgb.shape, view.depth.shape) == ((height, width, 3), (height, width))
        np.testing.assert_array_equal(view.intrinsics, data.cameras[view.camera].matrix)
        seen.add(view.camera)
    assert seen == {0, 1}


def test_it_is_whole_and_valid(cell):
    for command in ("verify", "validate"):
        ran = run(command, cell)
        assert ran.code == 0, ran
    assert "0 errors" in ran[1] + ran[2]
