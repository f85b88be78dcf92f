"""Mask errors: erosion and dilation of squares, swaps of neighbours, and how often they occur."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.apps.estimation.draws import Draw, sample_uniform
from synpick_warp.apps.estimation.mask_errors import FRACTION, disturb_labels, neighbours, resize_mask, swap_masks


def square(side: int, size: int = 160, at: int = 20, slot: int = 0) -> np.ndarray:
    label = np.zeros((size, size), np.uint8)
    label[at : at + side, at : at + side] = 1 + slot
    return label


@pytest.mark.parametrize(("side", "radius"), [(100, 5), (40, 2), (10, 1)])
def test_a_square_loses_its_radius_at_each_side(side, radius):
    """5 % of the side, and at least a pixel."""
    label = square(side)
    resize_mask(label, 0, grow=False)
    np.testing.assert_array_equal(label, square(side - 2 * radius, at=20 + radius))


def test_a_square_grows_by_its_radius_with_rounded_corners():
    label = square(100)
    resize_mask(label, 0, grow=True)
    rows, columns = np.nonzero(label)
    outside = np.hypot(np.maximum(0, np.maximum(20 - rows, rows - 119)), np.maximum(0, np.maximum(20 - columns, columns - 119)))
    assert outside.max() <= 5.0
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (15, 124, 15, 124)
    assert label[16, 16] == 0
    assert label[15, 60] == 1


def test_growth_covers_neighbours_and_ends_at_the_border():
    label = square(100, size=122, at=1)
    label[:, 102:] = 2
    resize_mask(label, 0, grow=True)
    assert (label[0] == 1).sum() >= 100
    assert (label[50, 101:106] == 1).all()
    assert (label[50, 106:] == 2).all()


def test_the_border_erodes_nothing_and_thin_masks_stay():
    label = np.ones((50, 80), np.uint8)
    label[:, 40:] = 0
    resize_mask(label, 0, grow=False)
    assert (label[:, :37] == 1).all()  # sqrt(2000) / 20 = 2.2 px.
    assert (label[:, 38:] == 0).all()
    line = np.zeros((50, 80), np.uint8)
    line[25, 10:70] = 3
    resize_mask(line, 2, grow=False)
    assert (line == 3).sum() > 0
    nothing = np.zeros((5, 5), np.uint8)
    resize_mask(nothing, 0, grow=False)
    assert not nothing.any()


def test_neighbours_touch():
    """BOP's boxes end at x + width, the last pixel."""
    boxes = np.array([[0, 0, 9, 9], [10, 0, 5, 5], [11, 20, 5, 5], [10, 10, 5, 5], [-1, -1, -1, -1], [3, 3, 2, 2], [11, 0, 5, 5]])
    assert neighbours(boxes, 0).tolist() == [1, 3, 5]


def test_swaps_exchange_masks():
    label = square(10) + 2 * square(10, at=60)
    swap_masks(label, 0, 1)
    np.testing.assert_array_equal(label, 2 * square(10) + square(10, at=60))


def checkerboard(cells: int = 12, side: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Label image of cells in a grid, each touching its neighbours, and their boxes."""
    slots = np.arange(cells * cells).reshape(cells, cells)
    boxes = [(side * column, side * row, side - 1, side - 1) for row in range(cells) for column in range(cells)]
    return np.kron(1 + slots, np.ones((side, side))).astype(np.uint8), np.array(boxes)


def test_errors_have_their_frequencies_and_follow_from_the_seed():
    kinds = np.zeros(3)
    label, boxes = checkerboard()
    count, images = len(boxes), 40
    for frame in range(images):
        changed = label.copy()
        disturb_labels(changed, boxes, np.arange(count), 3, 1, frame)
        again = label.copy()
        disturb_labels(again, boxes, np.arange(count), 3, 1, frame)
        np.testing.assert_array_equal(changed, again)
        centres = changed[6::12, 6::12].reshape(-1)
        kinds += (centres != 1 + np.arange(count)).sum(), 0, 0
        draws = sample_uniform(3, 1, frame, Draw.MASK_ERROR, np.arange(count), 2)[:, 0]
        kinds[1:] += (draws < FRACTION).sum(), ((draws >= FRACTION) & (draws < 2 * FRACTION)).sum()
    # 5,760 instances: the standard deviation of a frequency of 5 % is 0.3 %; swaps come in pairs, and a few find no partner.
    np.testing.assert_allclose(kinds / (count * images), FRACTION, atol=0.012)


def test_an_image_without_errors_stays():
    label, boxes = checkerboard(2)
    instances = np.arange(4)
    clean = next(frame for frame in range(100) if (sample_uniform(0, 0, frame, Draw.MASK_ERROR, instances, 2)[:, 0] > 2.5 * FRACTION).all())
    changed = label.copy()
    disturb_labels(changed, boxes, instances, 0, 0, clean)
    np.testing.assert_array_equal(changed, label)
