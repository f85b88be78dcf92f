"""Masks cut from images, and run lengths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from synpick_warp.exporters.rle import Crop, amodal_crop, run_lengths, visible_crop

SIDE = st.integers(1, 12)
EDGE = st.integers(-15, 25)


def decode(counts: list[int], height: int, width: int) -> np.ndarray:
    """COCO's definition: runs down the columns, in turn 0 and 1, beginning with 0."""
    values = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return values.reshape(width, height).T


def placed(crop: Crop, height: int, width: int) -> np.ndarray:
    full = np.zeros((height, width), bool)
    full[crop.top : crop.top + crop.mask.shape[0], crop.left : crop.left + crop.mask.shape[1]] = crop.mask
    return full


@pytest.mark.parametrize(
    ("mask", "counts"),
    [
        ([[0, 0], [0, 0]], [4]),
        ([[1, 1], [1, 1]], [0, 4]),
        ([[0, 1], [1, 0]], [1, 2, 1]),
        ([[1, 0], [0, 0]], [0, 1, 3]),
        ([[0, 0, 0], [0, 1, 1]], [3, 1, 1, 1]),
    ],
)
def test_known_run_lengths(mask, counts):
    assert run_lengths(Crop(np.array(mask, bool), 0, 0), *np.shape(mask)) == counts


def test_a_crop_without_pixels_has_no_runs():
    crop = Crop(np.zeros((0, 3), bool), 2, 1)
    assert run_lengths(crop, 4, 5) == [20]
    assert crop.box() is None
    assert crop.count == 0


@given(st.data())
def test_run_lengths_decode_to_the_mask(data):
    mask = data.draw(hnp.arrays(bool, st.tuples(SIDE, SIDE)))
    rows, columns = mask.shape
    height, width = rows + data.draw(st.integers(0, 3)), columns + data.draw(st.integers(0, 3))
    crop = Crop(mask, data.draw(st.integers(0, height - rows)), data.draw(st.integers(0, width - columns)))
    counts = run_lengths(crop, height, width)
    assert sum(counts) == height * width
    assert all(counts[1:])
    assert all(type(count) is int for count in counts)
    np.testing.assert_array_equal(decode(counts, height, width), placed(crop, height, width))


@given(hnp.arrays(np.uint32, st.tuples(SIDE, SIDE), elements=st.sampled_from([0, 1, 5, 2**31, 2**32 - 1])), st.sampled_from([0, 2, 31]))
def test_amodal_bits_become_masks(bits, instance):
    height, width = bits.shape
    whole = amodal_crop(bits, instance, np.array([-3, -2, width + 4, height], np.int32))
    np.testing.assert_array_equal(placed(whole, height, width), (bits >> np.uint32(instance)) & 1 == 1)


@given(hnp.arrays(np.uint8, st.tuples(SIDE, SIDE), elements=st.integers(0, 3)), st.tuples(EDGE, EDGE, EDGE, EDGE))
def test_a_crop_holds_what_lies_in_its_box(instances, box):
    height, width = instances.shape
    rows, columns = np.mgrid[:height, :width]
    inside = (columns >= box[0]) & (rows >= box[1]) & (columns <= box[2]) & (rows <= box[3])
    crop = visible_crop(instances, 1, np.array(box, np.int32))
    expected = (instances == 2) & inside
    np.testing.assert_array_equal(placed(crop, height, width), expected)
    assert crop.count == expected.sum()
    if expected.any():
        ys, xs = np.nonzero(expected)
        assert crop.box() == (xs.min(), ys.min(), xs.max(), ys.max())
    else:
        assert crop.box() is None
