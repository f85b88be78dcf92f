"""Everything that can be randomized at once: the bytes of a data set do not depend on the number of worlds."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from synpick_warp.codes import LookKind
from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKING, boxes
from tests.harness.exporter_contract import digests
from tests.worlds.cells import make_camera
from tests.worlds.small_worlds import cluttered_catalog, settings

ANY_COLOR = {"uniform": [[0, 0, 0], [1, 1, 1]]}
DRAWN: dict[str, Any] = {
    "object_hue": {"uniform": [-180, 180]},
    "object_brightness": {"log_uniform": [0.5, 2]},
    "object_roughness": {"normal": [0.5, 0.2]},
    "object_metallic": {"choice": [0, 0.9], "weights": [2, 1]},
    "bin_color": ANY_COLOR,
    "bin_roughness": {"uniform": [0.2, 0.9]},
    "bin_metallic": {"choice": [0, 1]},
    "table_color": ANY_COLOR,
    "table_roughness": {"uniform": [0.2, 0.9]},
    "texture_width": {"log_uniform": [0.05, 0.5]},
    "lamps": {"uniform": [0, 4]},
    "lamp_variants": 2,
    "lamp_elevation": {"uniform": [20, 80]},
    "lamp_radius": {"log_uniform": [1, 10]},
    "lamp_strength": {"uniform": [0.2, 0.8]},
    "lamp_temperature": {"choice": [2700, 6500]},
    "distractors": {"choice": [0, 1, 2]},
    "surfaces": 3,
    "exposure": {"normal": [0, 1]},
}
CAMERAS = (
    make_camera(
        "jittered",
        (0.0, -0.6, 1.2),
        (0.0, 0.0, 0.1),
        resolution=[48, 27],
        fov=60.0,
        jitter={
            "position": {"normal": [0.0, 0.02]},
            "rotation": {"uniform": [-1.0, 1.0]},
            "focal_length": {"choice": [-0.02, 0.02]},
            "center": {"uniform": [-1.0, 1.0]},
        },
    ),
    make_camera("still", (0.0, 0.0, 1.4), (0.0, 0.0, 0.1), resolution=[32, 32], fov=50.0, distortion=[-0.1, 0.05, 0.0, 0.0, 0.0]),
)
FOLDERS = ("bin_textures", "table_textures", "background_textures", "distractor_models")
GIVEN = PICKING | {
    "arrangement.max_objects": 4,
    "arrangement.upright": 0.5,
    "bake.episodes": 3,
    "bake.formats": ["bop", "usd", "zarr"],
    "bins.shift": [0.05, 0.03],
    "bins.yaw": 20.0,
    "effects.exposure_jitter": 0.3,
    "render.layers": ["albedo", "classes", "depth_sensor"],
    "render.table_size": [0.9, 0.6],
    **{f"randomize.{name}": value for name, value in DRAWN.items()},
}


def test_all_settings_and_kinds_of_distributions_are_on():
    assert {item.name for item in fields(Randomize)} == {*DRAWN, *FOLDERS}
    kinds = {value.kind for value in vars(settings(**GIVEN).randomize).values() if isinstance(value, Distribution)}
    assert kinds == {kind.name.lower() for kind in LookKind} - {"off", "fixed"}


def bake(place: Path, worlds: int) -> dict[str, str]:
    """Bake boxes; returns the digests of all files but those of settings."""
    textures = place.parent / "textures"
    textures.mkdir(exist_ok=True)
    for index, color in enumerate(((30, 60, 200), (200, 180, 20))):
        image = np.full((8, 8, 3), color, np.uint8)
        image[:4] //= 2
        cv2.imwrite(str(textures / f"{index}.png"), image)
    folders = {f"randomize.{name}": str(textures) for name in FOLDERS}
    with boxes(cluttered_catalog):
        run_bake(replace(settings(**(GIVEN | folders | {"bake.worlds": worlds})), camera=CAMERAS), place, SilentProgress())
    return {name: digest for name, digest in digests(place).items() if not name.endswith(("config.toml", "manifest.json"))}


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> tuple[Path, dict[str, str]]:
    place = tmp_path_factory.mktemp("randomized") / "1"
    return place, bake(place, 1)


@pytest.mark.parametrize("worlds", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_bytes_do_not_depend_on_worlds(single, worlds):
    place, expected = single
    found = bake(place.with_name(str(worlds)), worlds)
    assert [name for name in expected if found.get(name) != expected[name]] == []
    assert found.keys() == expected.keys()


def test_episodes_look_different(single):
    images = [cv2.imread(str(path)).astype(int) for path in sorted(single[0].glob("train/*/rgb/000000.png"))[::2]]
    assert len(images) == 3
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(images[first] - images[second]).mean() > 10
