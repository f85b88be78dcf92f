"""Meshes of anyone at given poses, without simulation: a cube seen from above has known depth, mask and normals."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import synpick_warp
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.types import Camera

SIDE, HEIGHT = 0.1, 0.5
K = [[64.0, 0.0, 32.0], [0.0, 64.0, 24.0], [0.0, 0.0, 1.0]]
DOWN = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, HEIGHT], [0.0, 0.0, 0.0, 1.0]])
CAMERA = Camera.at(K, (64, 48), DOWN)
BOX = trimesh.creation.box([SIDE] * 3)
CUBE = (BOX.vertices, BOX.faces)


def at(x: float) -> np.ndarray:
    return np.array([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def test_depth_mask_and_normals_of_a_cube():
    views = synpick_warp.render([(CUBE, at(0.0))], [CAMERA, CAMERA], layers=("normals",), device="cpu")
    half = 64.0 * SIDE / 2 / (HEIGHT - SIDE / 2)
    rows, columns = (np.abs(np.arange(size) + 0.5 - size / 2) < half for size in (48, 64))
    expected = np.outer(rows, columns)
    for view in range(2):
        assert np.array_equal(views["instance"][view], expected.astype(np.uint8))
        assert np.allclose(views["depth"][view], np.where(expected, HEIGHT - SIDE / 2, 0.0), atol=1e-4)
        assert np.array_equal(views["normals"][view][expected], np.broadcast_to([0.0, 0.0, -1.0], (expected.sum(), 3)))
    assert views["color"].shape == (2, 48, 64, 3)
    assert views["color"][0][expected].min() > 20


def test_two_instances_share_a_mesh(tmp_path):
    file = tmp_path / "cube.stl"
    BOX.export(file)
    views = synpick_warp.render([(file, at(-0.1)), (str(file), at(0.1))], [CAMERA], device="cpu")
    left, right = (np.argwhere(views["instance"][0] == number)[:, 1] for number in (1, 2))
    assert left.max() < 32 <= right.min()
    assert len(left) == len(right) > 100


@pytest.mark.parametrize(
    ("objects", "options", "expected"),
    [
        ([], {}, "render has 0 objects; allowed: 1 to 251"),
        ([(CUBE, at(0.0))], {"layers": ("normal",)}, "render has no layer normal; allowed: normals, "),
        ([(CUBE, at(0.0))], {"backend": "jax"}, 'backend is "jax"; allowed: numpy, torch'),
    ],
)
def test_mistakes_are_named(objects, options, expected):
    with pytest.raises(ConfigError, match=expected):
        synpick_warp.render(objects, [CAMERA], device="cpu", **options)
