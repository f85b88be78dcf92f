"""Run-length encoding: runs of masks from run boundaries of images, and COCO's counts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pycocotools import mask as coco

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.exporters.writing.rle import RunBoundaries, Runs, find_run_boundaries, find_runs, split_listed_runs
from synpick_warp.views.frames import most_words, unpack_mask
from tests.twins.masks import pack_masks

SIDE = st.integers(1, 12)


def decode(counts: list[int], height: int, width: int) -> np.ndarray:
    """Decode COCO's uncompressed RLE: column-major runs that alternate between 0 and 1, starting with 0."""
    values = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return values.reshape(width, height).T


def paint(runs: Runs, height: int, width: int) -> np.ndarray:
    full = np.zeros((height, width), bool)
    for column, first, past in zip(runs.column, runs.first, runs.past, strict=True):
        assert not full[first:past, column].any()
        full[first:past, column] = True
    return full


def place_randomly(image: np.ndarray, data: st.DataObject) -> tuple[np.ndarray, int, int, int, int]:
    """A crop, its first row and column, and height and width of an image that contains it."""
    rows, columns = image.shape
    height, width = rows + data.draw(st.integers(0, 3)), columns + data.draw(st.integers(0, 3))
    return image, data.draw(st.integers(0, height - rows)), data.draw(st.integers(0, width - columns)), height, width


def paste(part: np.ndarray, top: int, left: int, height: int, width: int) -> np.ndarray:
    full = np.zeros((height, width), part.dtype)
    full[top : top + part.shape[0], left : left + part.shape[1]] = part
    return full


def runs_of_mask(mask: object) -> Runs:
    return find_runs(np.array(mask, np.uint8))


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
    assert runs_of_mask(mask).counts(*np.shape(mask)).tolist() == counts


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0), (2, 3)])
def test_an_empty_crop_has_no_runs(shape):
    runs = find_run_boundaries(np.zeros(shape, np.uint8), 2, 1).split_by_value([MAX_INSTANCES - 1])[0]
    assert runs.counts(4, 5).tolist() == [20]
    assert runs.box() is None
    assert runs.count == 0


@given(hnp.arrays(np.uint8, st.tuples(SIDE, SIDE), elements=st.integers(0, 3)), st.integers(1, 4), st.data())
def test_values_become_runs_and_run_lengths(image, value, data):
    part, top, left, height, width = place_randomly(image, data)
    expected = paste(part, top, left, height, width) == value
    runs = find_run_boundaries(part, top, left).runs_of(value)
    np.testing.assert_array_equal(paint(runs, height, width), expected)
    counts = runs.counts(height, width).tolist()
    assert sum(counts) == height * width
    assert all(counts[1:])
    np.testing.assert_array_equal(decode(counts, height, width), expected)
    assert runs.count == expected.sum()
    ys, xs = np.nonzero(expected)
    assert runs.box() == ((xs.min(), ys.min(), xs.max(), ys.max()) if expected.any() else None)


@given(hnp.arrays(bool, st.tuples(st.integers(1, 5), st.integers(1, 70), SIDE)), st.sampled_from([[0], [4, 1], range(5)]))
def test_packed_and_listed_masks_become_the_same_runs(masks, instances):
    """Words as the renderer packs them, and positions as it lists them."""
    _, height, width = masks.shape
    packed = pack_masks(masks)
    assert packed["mask_length"] <= len(masks) * most_words(width, height)
    crops = [unpack_mask(packed["mask_words"], *place) for place in zip(packed["mask_first"], packed["mask_box"], strict=True)]
    edges = [np.diff(np.pad(mask, ((1, 1), (0, 0))).astype(int), axis=0).T.ravel().nonzero()[0] for mask in masks]
    chosen = [instance for instance in instances if instance < len(masks)]
    listed = split_listed_runs(np.concatenate(edges).astype(np.uint32), np.array(list(map(len, edges))), height, chosen)
    for instance, runs in zip(chosen, listed, strict=True):
        left, top = packed["mask_box"][instance, :2]
        for one in (runs, find_runs(crops[instance], top, left)):
            np.testing.assert_array_equal(paint(one, height, width), masks[instance])
            assert one.count == masks[instance].sum()
            assert (one.top, one.bottom) == (runs.top, runs.bottom)


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@given(hnp.arrays(bool, st.tuples(SIDE, SIDE)))
def test_pycocotools_decodes_and_encodes_the_same_run_lengths(mask):
    height, width = mask.shape
    runs = runs_of_mask(mask)
    record = {"counts": runs.counts(height, width).tolist(), "size": [height, width]}
    theirs = coco.frPyObjects(record, height, width)
    np.testing.assert_array_equal(coco.decode(theirs), mask)
    assert coco.encode(np.asfortranarray(mask, np.uint8)) == theirs
    assert coco.area(theirs) == runs.count


@given(hnp.arrays(np.uint8, st.tuples(SIDE, SIDE), elements=st.sampled_from([0, 1, 2, 32, 251, 252, 255])), st.data())
def test_several_values_at_once_become_runs(image, data):
    part, top, left, height, width = place_randomly(image, data)
    for index, runs in zip((0, 1, 7, 250), find_run_boundaries(part, top, left).split_by_value((0, 1, 7, 250)), strict=True):
        np.testing.assert_array_equal(paint(runs, height, width), paste(image == 1 + index, top, left, height, width))


def test_images_with_more_positions_than_32_bits_are_split():
    place = np.array([5, 2**12, 2**35, 2**35 + 1], np.uint64)
    boundaries = RunBoundaries(place, 2**13, np.array([0, 9, 0, 9], np.uint32), np.array([9, 0, 9, 0], np.uint32))
    for runs in (boundaries.runs_of(9), boundaries.split_by_value([3, 8])[1]):
        assert [part.tolist() for part in (runs.column, runs.first, runs.past)] == [[0, 2**22], [5, 0], [2**12, 1]]
        assert (runs.count, runs.top, runs.bottom) == (2**12 - 4, 0, 2**12)
