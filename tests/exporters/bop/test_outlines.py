"""Outlines of masks: exact for readers that fill polygons by OpenCV and by pycocotools."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pycocotools import mask as coco

from synpick_warp.exporters.bop.outlines import Polygon, join_parts, trace_outlines
from synpick_warp.exporters.writing.rle import find_run_boundaries
from tests.harness.fuzz import fuzz_examples

MASKS = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(lambda shape: arrays(bool, shape))
FROM = (3, 5)
"""Row and column of the masks in an image."""


def outlines(mask: np.ndarray) -> list[Polygon]:
    return trace_outlines(find_run_boundaries(mask.astype(np.uint8), *FROM).runs_of(1))


def area(polygon: Polygon) -> float:
    """By the shoelace formula [px²]."""
    (x, y), (ahead_x, ahead_y) = polygon.points.T, np.roll(polygon.points, -1, axis=0).T
    return 0.5 * float(np.sum(x * ahead_y - ahead_x * y))


@pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")
@settings(max_examples=fuzz_examples(200), deadline=None)
@given(mask=MASKS)
def test_polygons_fill_to_the_mask(mask):
    image = np.zeros((20, 20), bool)
    image[FROM[0] : FROM[0] + mask.shape[0], FROM[1] : FROM[1] + mask.shape[1]] = mask
    parts = outlines(mask)
    filled = np.zeros(image.shape, np.uint8)
    for part in parts:
        alone = np.zeros_like(filled)
        np.testing.assert_array_equal(part.at_pixels().astype(np.int32), np.round(part.at_pixels()))
        cv2.fillPoly(alone, [part.at_pixels().astype(np.int32)], 1)
        filled |= alone
    np.testing.assert_array_equal(filled, image)
    assert len(parts) == cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[0] - 1
    assert sum(map(area, parts)) == mask.sum()
    if parts:
        rings = coco.frPyObjects([part.points.ravel().tolist() for part in parts], *image.shape)
        np.testing.assert_array_equal(coco.decode(coco.merge(rings)), image)
        assert area(join_parts(parts)) == pytest.approx(mask.sum())


def test_an_outline_goes_around_clockwise_and_into_a_hole():
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    (part,) = outlines(ring)
    x, y = part.points.T - np.array([FROM[1], FROM[0]])[:, None]
    assert (x.min(), x.max(), y.min(), y.max()) == (0, 3, 0, 3)
    assert area(part) == 8
    assert {(1.0, 1.5), (0.0, 1.5)} <= set(zip(x.tolist(), y.tolist(), strict=True))
