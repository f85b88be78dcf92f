"""Pixel counts and bounding boxes of instances, against a NumPy twin and known sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.configs.schema import Config
from tests.twins.annotate import annotated
from tests.worlds.toy_scene import FLAT, UPRIGHT, ToyScene, ball, box, camera, entry, one, random_pile, sheet

VIEW = camera(96, 54, 272.2, (0.0, 0.0, 2.0))
SHEET = one(sheet(0.1, 0.1), FLAT, VIEW)
"""0.1 m at 2 m and f = 272.2 px: 13.61 px, about column 48 and row 27, holds 14 columns and rows."""


def check_view(toy: ToyScene, device) -> tuple[list, list]:
    """Compare a toy scene's counts and boxes with those of the NumPy twin, and return them."""
    picture, pixels, boxes = annotated(toy, device)
    np.testing.assert_array_equal(picture.pixels[0], pixels)
    np.testing.assert_array_equal(picture.boxes[0], boxes)
    return pixels.tolist(), boxes.tolist()


def test_a_sheet_of_known_size_and_absent_instances(device):
    pixels, boxes = check_view(SHEET, device)
    assert pixels == [[196, 196, 196], *[[0, 0, 0]] * 3]
    assert boxes == [[[41, 20, 54, 33]] * 2, *[[[0, 0, -1, -1]] * 2] * 3]


def test_occluded_pixels_count_as_amodal_but_not_as_visible(device):
    above = [(1, (0.0, 0.0, 0.1, *UPRIGHT))]
    pixels, boxes = check_view(replace(SHEET, entries=[*SHEET.entries, entry(sheet(0.2, 0.2))], placed=[SHEET.placed[0] + above]), device)
    assert pixels[0] == [196, 196, 0]
    assert boxes[0] == [[41, 20, 54, 33], [0, 0, -1, -1]]
    assert pixels[1][2] == pixels[1][0]


@pytest.mark.parametrize("place", [(0.34, 0.0), (-0.35, 0.2), (0.0, -0.2), (0.45, 0.0), (0.9, 0.5), (1.3, 0.0)])
def test_instances_that_leave_the_image_count_beyond_its_border(device, place):
    """Half inside, across a corner, just outside, far outside at the end of the canvas."""
    toy = ToyScene([entry(ball(0.1, 3))], [[(0, (*place, 0.1, *UPRIGHT)), (0, (*place, -0.3, *UPRIGHT))]], (VIEW,))
    pixels, boxes = check_view(toy, device)
    if place == (0.34, 0.0):
        assert 0 < pixels[0][1] < pixels[0][0]
        assert boxes[0][0][2] > 95
        assert boxes[0][1][2] == 95


def test_instances_that_reach_behind_the_camera_count_up_to_the_canvas(device):
    pixels, _ = check_view(one(box(0.02, 0.1, 4.0), (0.1, 0.0, 1.0, *UPRIGHT), VIEW), device)
    assert pixels[0][0] > pixels[0][1]


def test_depth_above_sixteen_bits_is_0_and_not_valid(device):
    pixels, _ = check_view(replace(SHEET, config=Config().with_values({"bop.depth_scale": 0.03})), device)
    assert pixels[0] == [196, 0, 196]


@pytest.mark.parametrize("seed", range(3))
def test_random_piles_match_the_twin(device, seed):
    entries = [entry(box(0.2, 0.1, 0.05)), entry(ball(0.08, 2))]
    placed = random_pile(np.random.default_rng(seed), 2, 7, (-0.45, -0.3, -0.1), (0.45, 0.3, 0.4))
    check_view(ToyScene(entries, [placed], (VIEW,), instances=32, table=True, fixtures_visible=(1, 1, 0)), device)
