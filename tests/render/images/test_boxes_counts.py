"""Pixel counts and bounding boxes of instances, against a NumPy twin and known sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.configs.schema import Config
from synpick_warp.scenes.types import Camera
from tests.twins.annotate import count_pixels
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, camera, entry, render, sheet

VIEW = camera(96, 54, 272.2, (0.0, 0.0, 2.0))


def canvas_camera(view: Camera) -> Camera:
    """The same camera with an image three times as wide and high, centred on the original."""
    matrix = view.matrix.copy()
    matrix[0, 2] += view.width
    matrix[1, 2] += view.height
    return Camera(3 * view.width, 3 * view.height, matrix, view.rotation, view.translation)


def check_view(toy: ToyScene, device) -> tuple[np.ndarray, np.ndarray]:
    """Compare a toy scene's counts and boxes with those of the NumPy twin, and return them."""
    picture = render(toy, device, colors=False)
    canvas = render(replace(toy, cameras=(canvas_camera(toy.cameras[0]),)), device, colors=False)
    pixels, boxes = count_pixels(picture.instance[0], picture.depth[0], picture.masks[0], canvas.masks[0])
    np.testing.assert_array_equal(picture.pixels[0], pixels)
    np.testing.assert_array_equal(picture.boxes[0], boxes)
    return picture.pixels[0], picture.boxes[0]


def test_a_sheet_of_known_size(device):
    # 0.1 m at 2 m and f = 272.2 px: 13.61 px, about column 48 and row 27, holds 14 columns and rows.
    pixels, boxes = check_view(ToyScene([entry(sheet(0.1, 0.1))], [[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], (VIEW,)), device)
    assert pixels[0].tolist() == [196, 196, 196]
    assert boxes[0].tolist() == [[41, 20, 54, 33]] * 2


def test_an_absent_instance_has_no_pixels(device):
    pixels, boxes = check_view(ToyScene([entry(sheet(0.1, 0.1))], [[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], (VIEW,)), device)
    assert pixels[1:].tolist() == [[0, 0, 0]] * 3
    assert boxes[1:].tolist() == [[[0, 0, -1, -1]] * 2] * 3


def test_occluded_pixels_count_as_amodal_but_not_as_visible(device):
    placed = [[(0, (0.0, 0.0, 0.0, *UPRIGHT)), (1, (0.0, 0.0, 0.1, *UPRIGHT))]]
    pixels, boxes = check_view(ToyScene([entry(sheet(0.1, 0.1)), entry(sheet(0.2, 0.2))], placed, (VIEW,)), device)
    assert pixels[0].tolist() == [196, 196, 0]
    assert boxes[0].tolist() == [[41, 20, 54, 33], [0, 0, -1, -1]]
    assert pixels[1, 2] == pixels[1, 0]


@pytest.mark.parametrize("place", [(0.34, 0.0), (-0.35, 0.2), (0.0, -0.2), (0.45, 0.0), (0.9, 0.5), (1.3, 0.0)])
def test_instances_that_leave_the_image_count_beyond_its_border(device, place):
    # Half inside, across a corner, just outside, far outside at the end of the canvas.
    toy = ToyScene([entry(ball(0.1, 3))], [[(0, (*place, 0.1, *UPRIGHT)), (0, (*place, -0.3, *UPRIGHT))]], (VIEW,))
    pixels, boxes = check_view(toy, device)
    if place == (0.34, 0.0):
        assert 0 < pixels[0, 1] < pixels[0, 0]
        assert boxes[0, 0, 2] > 95
        assert boxes[0, 1, 2] == 95


def test_instances_that_reach_behind_the_camera_count_up_to_the_canvas(device):
    toy = ToyScene([entry(box(0.02, 0.1, 4.0))], [[(0, (0.1, 0.0, 1.0, *UPRIGHT))]], (VIEW,))
    pixels, _ = check_view(toy, device)
    assert pixels[0, 0] > pixels[0, 1]


def test_pixels_without_depth_are_not_valid(device):
    config = replace(Config(), bop=replace(Config().bop, depth_scale=0.03))
    toy = ToyScene([entry(sheet(0.1, 0.1))], [[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], (VIEW,), config=config)
    pixels, _ = check_view(toy, device)
    assert pixels[0].tolist() == [196, 0, 196]


@pytest.mark.parametrize("seed", range(3))
def test_random_piles_match_the_twin(device, seed):
    rng = np.random.default_rng(seed)
    placed = []
    for _ in range(7):
        quaternion = rng.normal(size=4)
        place = rng.uniform((-0.45, -0.3, -0.1), (0.45, 0.3, 0.4))
        placed.append((int(rng.integers(2)), (*place, *(quaternion / np.linalg.norm(quaternion)))))
    toy = ToyScene(
        [entry(box(0.2, 0.1, 0.05)), entry(ball(0.08, 2))], [placed], (VIEW,), instances=32, table=True, fixtures_visible=(1, 1, 0)
    )
    check_view(toy, device)
