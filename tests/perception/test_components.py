"""Connected-component labeling of instances in images of segmentation ids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Segment
from synpick_warp.kernels.perception.components import STRIP
from tests.twins import perception
from tests.twins.perception import SegmenterHarness

WIDTH, HEIGHT = 75, 24
"""A row has two full strips and part of a third."""


@pytest.fixture(scope="module")
def harness(device):
    return SegmenterHarness(device, WIDTH, HEIGHT, worlds=2, instances=4)


def empty() -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH), np.uint8)


def random_segments(seed: int, scale: float, instances: int = 4) -> np.ndarray:
    """Random ids (H, W); `scale` [px] is the feature size: noise at 0, large patches at 8."""
    rng = np.random.default_rng(seed)
    segments = rng.choice(np.array([0, *range(1, instances + 1), Segment.TOTE], np.uint8), size=(HEIGHT, WIDTH))
    if scale > 0.0:
        rows, columns = np.mgrid[:HEIGHT, :WIDTH]
        wave = [(np.sin(columns / scale + a) * 2, np.cos(rows / scale + b) * 2) for a, b in rng.uniform(0, 6, (2, 2))]
        rows = np.clip(rows / scale + wave[0][0], 0, HEIGHT - 1).astype(int)
        segments = segments[rows, np.clip(columns / scale + wave[1][1], 0, WIDTH - 1).astype(int)]
    return segments


def test_largest_of_two_components(harness):
    segments = empty()
    segments[2:5, 3:7] = 1
    segments[10:15, 20:70] = 1
    harness.observe(segments)
    first, second = 2 * WIDTH + 3, 10 * WIDTH + 20
    expected = np.full((HEIGHT, WIDTH), -1)
    expected[2:5, 3:7], expected[10:15, 20:70] = first, second
    assert (harness.image("component") == expected).all()
    area = harness.image("area").ravel()
    assert [area[first], area[second], area.sum()] == [12, 250, 262]
    assert harness.image("largest").tolist() == [second, -1, -1, -1]
    assert [harness.result("visible", instance) for instance in range(2)] == [250, 0]


def test_ties_go_to_the_smallest_label(harness):
    segments = empty()
    segments[20, 1:4] = 3
    segments[4:7, 60] = 3
    harness.observe(segments)
    assert harness.image("largest")[2] == 4 * WIDTH + 60


@pytest.mark.parametrize("column", [int(STRIP) - 1, 40])
@pytest.mark.parametrize("step", [1, -1])
def test_pixels_that_touch_at_a_corner_are_one_component(harness, column, step):
    segments = empty()
    segments[5, column], segments[6, column + step] = 2, 2
    harness.observe(segments)
    assert harness.image("largest")[1] == 5 * WIDTH + column
    assert harness.result("visible", 1) == 2


def test_touching_instances_are_separate_components(harness):
    segments = empty()
    segments[:, :37], segments[:, 37:] = 1, 2
    harness.observe(segments)
    assert harness.image("largest").tolist() == [0, 37, -1, -1]
    assert [harness.result("visible", i) for i in range(2)] == [37 * HEIGHT, 38 * HEIGHT]


def test_fixtures_and_ids_beyond_the_capacity_are_no_instances(harness):
    segments = empty()
    segments[:8], segments[8:16], segments[16:] = Segment.TOTE, Segment.TABLE, 5
    harness.observe(segments)
    assert (harness.image("component") == -1).all()
    assert (harness.image("area") == 0).all()
    assert (harness.image("largest") == -1).all()


def test_a_spiral_is_one_component(harness):
    """Its arms meet late, so labels must propagate through many rows and strips."""
    segments = empty()
    top, left, bottom, right = 0, 0, HEIGHT - 1, WIDTH - 1
    while top < bottom and left < right:
        segments[top, left : right + 1], segments[top : bottom + 1, right] = 1, 1
        segments[bottom, left + 2 : right + 1], segments[top + 2 : bottom + 1, left + 2] = 1, 1
        top, left, bottom, right = top + 2, left + 2, bottom - 2, right - 2
    harness.observe(segments)
    assert set(np.unique(harness.image("component"))) == {-1, 0}
    assert harness.result("visible") == (segments == 1).sum()


def test_results_go_to_the_world_of_each_view_and_unused_views_write_nothing(harness):
    segments = empty()
    segments[3:9, 3:9] = 1
    harness.observe(segments, segments)
    before = harness.image("component", 1)
    other = empty()
    other[12:15, 3:9] = 1
    harness.observe(other, np.full_like(segments, 2), worlds=[1])
    assert [harness.result("visible", 0, world) for world in range(2)] == [36, 18]
    assert harness.result("visible", 1, world=0) == 0
    assert (harness.image("component", 1) == before).all()
    assert (harness.image("largest", 1) == -1).all()
    assert (harness.image("contour_length", 1) == 0).all()


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([0.0, 1.5, 3.0, 8.0]))
def test_same_as_opencv(seed, scale, harness):
    segments = random_segments(seed, scale)
    harness.observe(segments)
    labels = perception.label_components(segments, 4)
    assert (harness.image("component") == labels).all()
    names, sizes = np.unique(labels[labels >= 0], return_counts=True)
    area = np.zeros(HEIGHT * WIDTH)
    area[names] = sizes
    assert (harness.image("area").ravel() == area).all()
    assert harness.image("largest").tolist() == [perception.largest_label(labels, segments, i) for i in range(4)]
