"""Border following and Euclidean distance transform of the largest components."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.twins import perception
from tests.twins.perception import SegmenterHarness

WIDTH, HEIGHT = 48, 32


@pytest.fixture(scope="module")
def harness(device):
    return SegmenterHarness(device, WIDTH, HEIGHT, instances=3)


def empty() -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH), np.uint8)


def random_segments(seed: int, scale: int) -> np.ndarray:
    """Random ids (H, W) of three instances; `scale` [px] is the size of the blobs; 1: noise."""
    rng = np.random.default_rng(seed)
    noise = rng.uniform(size=(3, HEIGHT, WIDTH)).astype(np.float32)
    noise = np.stack([cv2.blur(layer, (scale, scale)) for layer in noise])
    return np.where(noise.max(axis=0) > np.quantile(noise.max(axis=0), 0.4), noise.argmax(axis=0) + 1, 0).astype(np.uint8)


def masks(harness: SegmenterHarness, segments: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """(instance, mask of its largest component) of all visible instances, by the reference implementation."""
    labels = perception.label_components(segments, 3)
    names = [perception.largest_label(labels, segments, instance) for instance in range(3)]
    return [(instance, labels == name) for instance, name in enumerate(names) if name >= 0]


def test_rectangle(harness):
    segments = empty()
    segments[4:7, 10:15] = 1
    harness.observe(segments)
    around = [(10, 4), (10, 5), (10, 6), (11, 6), (12, 6), (13, 6), (14, 6), (14, 5), (14, 4), (13, 4), (12, 4), (11, 4)]
    assert [tuple(point) for point in harness.contour()] == around
    assert harness.result("centroid").tolist() == [12.0, 5.0]
    assert (harness.image("distance")[4:7, 10:15] == [[1, 1, 1, 1, 1], [1, 2, 2, 2, 1], [1, 1, 1, 1, 1]]).all()


def test_single_pixel(harness):
    segments = empty()
    segments[4, 10] = 1
    harness.observe(segments)
    assert harness.contour().tolist() == [[10, 4]]
    assert harness.result("centroid").tolist() == [10.0, 4.0]
    assert harness.image("distance")[4, 10] == 1.0


@pytest.mark.parametrize(("row", "column"), [(0, 1), (1, 0), (1, 1), (1, -1)])
def test_line_is_traversed_in_both_directions(harness, row, column):
    segments = empty()
    steps = np.arange(5)
    segments[8 + row * steps, 20 + column * steps] = 1
    harness.observe(segments)
    points = harness.contour()
    assert len(points) == 8
    assert (points[:5] == np.stack([20 + column * steps, 8 + row * steps], axis=1)).all()
    # The ends count once and all other points twice; the mean is still the centre.
    assert harness.result("centroid").tolist() == [20.0 + 2 * column, 8.0 + 2 * row]
    assert harness.image("distance").max() == 1.0


def test_hole_changes_the_distance_and_not_the_centroid(harness):
    segments = empty()
    segments[5:26, 10:31] = 1
    harness.observe(segments)
    whole, length = harness.result("centroid").tolist(), len(harness.contour())
    assert harness.image("distance")[15, 15] == 6.0
    segments[13:16, 16:19] = 0
    harness.observe(segments)
    assert harness.result("centroid").tolist() == whole == [20.0, 15.0]
    assert len(harness.contour()) == length == 80
    distance = harness.image("distance")
    assert [distance[14, 17], distance[15, 15]] == [0.0, 1.0]
    assert distance[17, 15] == pytest.approx(np.sqrt(5.0), rel=1e-6)


def test_pixels_beyond_the_image_border_are_outside(harness):
    harness.observe(np.full((HEIGHT, WIDTH), 2, np.uint8))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    expected = np.minimum.reduce([rows + 1, HEIGHT - rows, columns + 1, WIDTH - columns])
    assert (harness.image("distance") == expected).all()
    assert len(harness.contour(1)) == 2 * (WIDTH + HEIGHT) - 4
    assert harness.result("centroid", 1).tolist() == [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]


def test_pixels_of_a_touching_instance_are_outside(harness):
    segments = empty()
    segments[6:20, :20], segments[6:20, 20:] = 1, 2
    harness.observe(segments)
    distance = harness.image("distance")
    assert distance[12, 17:22].tolist() == [3.0, 2.0, 1.0, 1.0, 2.0]
    assert [harness.contour(0)[:, 0].max(), harness.contour(1)[:, 0].min()] == [19, 20]


def test_smaller_components_have_no_distance(harness):
    segments = empty()
    segments[5:10, 5:10], segments[20:30, 20:30] = 1, 1
    harness.observe(segments)
    distance = harness.image("distance")
    assert (distance[:15] == 0.0).all()
    assert distance.max() == 5.0


def test_contour_beyond_the_capacity_is_truncated_and_flagged(device):
    short = SegmenterHarness(device, WIDTH, HEIGHT, worlds=2, instances=2, contour_points=16)
    small, large = empty(), empty()
    small[4:9, 4:9] = 2
    large[4:9, 4:10], large[20:29, 20:29] = 2, 1
    short.observe(small, large)
    assert short.observation.overflow.numpy().tolist() == [0, 1]
    assert len(short.contour(1, view=0)) == 16
    expected = perception.contour(large == 2)
    assert len(expected) == 18
    assert (short.contour(1, view=1) == expected[:16]).all()
    # The next observation clears the flag.
    short.observe(small, worlds=[1])
    assert short.observation.overflow.numpy().tolist() == [0, 0]


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1, 3, 5, 9]))
def test_contours_same_as_opencv(seed, scale, harness):
    segments = random_segments(seed, scale)
    harness.observe(segments)
    for instance, mask in masks(harness, segments):
        expected = perception.contour(mask)
        assert (harness.contour(instance) == expected).all()
        np.testing.assert_allclose(harness.result("centroid", instance), perception.centroid(expected), atol=1e-4)


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1, 3, 5, 9]))
def test_distances_same_as_all_pairs_and_opencv(seed, scale, harness):
    segments = random_segments(seed, scale)
    harness.observe(segments)
    expected, similar = np.zeros((2, HEIGHT, WIDTH))
    for _, mask in masks(harness, segments):
        expected += np.sqrt(perception.squared_distance(mask))
        similar += cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    assert (harness.image("distance") == expected.astype(np.float32)).all()
    np.testing.assert_allclose(harness.image("distance"), similar, atol=1e-3)
