"""Measures of the validation against known answers and brute force: masks, shifts, diameters, TIFF headers, symmetries."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from synpick_warp.apps.validation.comparison import best_shift, fit_masks, moved
from synpick_warp.apps.validation.model_files import diameter, sample_area
from synpick_warp.apps.validation.rules.coco import run_lengths
from synpick_warp.apps.validation.rules.images import wrong_sides
from synpick_warp.apps.validation.scene_files import crop_mask, decode_mask, png_type
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.image_files import decode_picture, image_size

masks = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).random((7, 9)) < 0.3)


@given(masks)
def test_a_cropped_mask_is_the_whole_one(mask):
    cropped = crop_mask(mask, "")
    assert cropped.count == mask.sum()
    np.testing.assert_array_equal(cropped.window(0, 0, 9, 7), mask)
    padded = np.pad(mask, 3)
    np.testing.assert_array_equal(cropped.window(-3, -3, 15, 13), padded)
    np.testing.assert_array_equal(cropped.window(2, 1, 4, 5), mask[1:6, 2:6])


@given(masks)
def test_run_lengths_decode_to_the_mask(mask):
    counts = run_lengths(crop_mask(mask, ""))
    np.testing.assert_array_equal(np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(9, 7).T, mask)


@pytest.mark.parametrize("shift", [(3, 0), (0, -2), (-5, 4), (1, 1), (0, 0)])
def test_a_shift_is_measured(shift):
    silhouette = np.zeros((60, 70), bool)
    silhouette[20:40, 15:45] = True
    silhouette[35:45, 40:50] = True
    mask = moved(silhouette, *shift)
    assert best_shift(mask, silhouette) == shift
    np.testing.assert_array_equal(moved(mask, -shift[0], -shift[1]), silhouette)


def test_a_shift_by_one_pixel_is_no_fit_and_the_half_pixel_convention_is():
    rows, columns = np.mgrid[:120, :120]
    disc = (rows - 60.0) ** 2 + (columns - 60.0) ** 2 < 40.0**2
    half = (rows - 60.0) ** 2 + (columns - 60.5) ** 2 < 40.0**2
    assert fit_masks(disc, disc).iou == 1.0
    assert fit_masks(disc, half).good
    assert not fit_masks(disc, np.roll(disc, 2, axis=1)).good
    square = np.zeros((120, 120), bool)
    square[30:90, 30:90] = True
    assert not fit_masks(square, np.roll(square, (1, 1), axis=(0, 1))).good


@pytest.mark.parametrize("count", [2, 10, 700, 3000])
def test_the_diameter_is_the_largest_distance(count):
    points = np.random.default_rng(count).normal(size=(count, 3)) * (1.0, 2.0, 30.0) + 100.0
    assert diameter(points) == pytest.approx(pdist(points).max(), rel=1e-9)


def test_the_diameter_of_a_flat_model():
    x, y = np.meshgrid(np.arange(50.0), np.arange(40.0))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    assert diameter(points) == pytest.approx(np.hypot(49.0, 39.0), rel=1e-9)


def test_samples_are_spread_evenly_over_the_area():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [4, 0, 0], [4, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    points = sample_area(vertices, faces, 4000)
    assert points[:, 0].mean() == pytest.approx(2.0, abs=0.02)
    assert points[:, 1].mean() == pytest.approx(0.5, abs=0.02)
    assert (points[:, 2] == 0.0).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tiff_images_decode_and_state_their_size(dtype):
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (31, 47)).astype(dtype)
    data = cv2.imencode(".tif", image)[1].tobytes()
    assert image_size(data) == (47, 31)
    np.testing.assert_array_equal(decode_picture(data, "x.tif", DatasetError), image)
    with pytest.raises(DatasetError):
        decode_picture(data[:40], "x.tif", DatasetError)


def test_types_of_masks():
    image = np.zeros((5, 6), np.uint8)
    image[2:4, 1:3] = 255
    good = decode_mask(cv2.imencode(".png", image)[1].tobytes(), "")
    assert (good.binary, good.kind, good.box) == (True, (8, "greyscale"), (1, 2, 2, 2))
    image[0, 0] = 1
    assert not decode_mask(cv2.imencode(".png", image)[1].tobytes(), "").binary
    assert png_type(cv2.imencode(".png", image.astype(np.uint16))[1].tobytes()) == (16, "greyscale")


# ---- amodal boxes against masks that the border of the image cuts ----

LEFT, TOP, RIGHT, BOTTOM = range(4)
SIZE = (100, 60)
"""Width and height of the image [px]."""


def mask(*box: int) -> Any:
    """Mask with a tight box x_min, y_min, width, height [px]."""
    return SimpleNamespace(box=box, size=SIZE)


@pytest.mark.parametrize(
    ("seen", "stated", "wrong"),
    [
        pytest.param((10, 20, 30, 15), [10, 20, 29, 14], [], id="inside"),
        pytest.param((10, 20, 30, 15), [10, 20, 30, 15], [RIGHT, BOTTOM], id="inside, with one more"),
        pytest.param((10, 20, 30, 15), [-5, 20, 44, 14], [LEFT], id="inside, beyond the border"),
        pytest.param((10, 0, 30, 15), [4, -9, 45, 23], [], id="cut at the top, wider beyond"),
        pytest.param((10, 0, 30, 15), [4, -9, 45, 24], [BOTTOM], id="cut at the top, and too low"),
        pytest.param((10, 0, 30, 15), [12, -9, 40, 23], [LEFT], id="cut at the top, and narrower than the mask"),
        pytest.param((0, 0, 30, 15), [-9, -9, 50, 50], [], id="cut at two sides"),
        pytest.param((15, 0, 23, 2), [-52, -165, 194, 176], [], id="cut at the top, and lower around the corner"),
        pytest.param((15, 0, 23, 2), [-52, -165, 80, 176], [RIGHT], id="around the corner, and narrower than the mask"),
    ],
)
def test_sides_are_wrong_where_the_mask_contradicts_them(seen, stated, wrong):
    assert wrong_sides(stated, mask(*seen)) == wrong
