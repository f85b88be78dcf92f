"""Grasp points: pole of inaccessibility, choice among the three candidates, and visible fractions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.twins import perception
from tests.twins.perception import SegmenterHarness

WIDTH, HEIGHT = 64, 48


@pytest.fixture(scope="module")
def shared(device):
    return SegmenterHarness(device, WIDTH, HEIGHT, instances=2)


@pytest.fixture
def harness(shared):
    """Each instance has a mass of 0.1 kg and an expected area of 0.01 m² unless a test changes them."""
    shared.mass[:], shared.area[:] = 0.1, 0.01
    return shared


def empty() -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH), np.uint8)


def candidates(harness: SegmenterHarness, instance: int = 0) -> dict[str, np.ndarray]:
    return {name: harness.result(name, instance) for name in ("pole", "centroid", "midpoint", "distances", "grasp_pixel")}


def blob(seed: int) -> np.ndarray:
    """Ids (H, W): instance 0 is a union of random ellipses, partly covered by an ellipse of instance 1."""
    rng = np.random.default_rng(seed)
    image = empty()
    for code in (1, 1, 1, 2):
        middle = rng.integers((8, 8), (WIDTH - 8, HEIGHT - 8))
        cv2.ellipse(image, middle.tolist(), rng.integers(3, 16, 2).tolist(), float(rng.uniform(0, 180)), 0, 360, code, -1)
    return image


# ---- candidates and the choice ----


def test_square_is_grasped_at_its_center(harness):
    segments = empty()
    segments[10:31, 20:41] = 1
    harness.observe(segments)
    found = candidates(harness)
    assert found["pole"].tolist() == found["centroid"].tolist() == found["midpoint"].tolist() == [30.0, 20.0]
    assert found["distances"].tolist() == [11.0, 11.0, 11.0]
    assert found["grasp_pixel"].tolist() == [30, 20]


def test_first_of_equal_poles_is_kept_and_the_centroid_is_preferred(harness):
    """A long bar has a row of equal poles; the centroid, at the same distance from the contour, is chosen."""
    segments = empty()
    segments[10:21, 5:46] = 1
    harness.observe(segments)
    found = candidates(harness)
    assert found["pole"].tolist() == [10.0, 15.0]
    assert found["centroid"].tolist() == [25.0, 15.0]
    assert found["distances"].tolist() == [6.0, 6.0, 6.0]
    assert found["grasp_pixel"].tolist() == [25, 15]


def test_pole_is_chosen_if_the_centroid_lies_outside(harness):
    """An L with arms of 5 and 9 px: its centroid and the midpoint lie outside."""
    segments = empty()
    segments[4:44, 4:13], segments[39:44, 4:60] = 1, 1
    harness.observe(segments)
    found = candidates(harness)
    assert segments[tuple(np.rint(found["centroid"][::-1]).astype(int))] == 0
    assert found["distances"][:2].tolist() == [5.0, 0.0]
    assert found["grasp_pixel"].tolist() == found["pole"].tolist() == [8, 8]


def test_midpoint_is_chosen_if_it_is_farther_from_the_contour(harness):
    """A large square with a thin tail that shifts the centroid."""
    segments = empty()
    segments[4:25, 4:25], segments[12:17, 25:63] = 1, 1
    harness.observe(segments)
    found = candidates(harness)
    pole, centroid, middle = found["distances"]
    assert pole == 11.0
    assert found["pole"].tolist() == [14.0, 14.0]
    assert centroid < middle
    assert 0.4 < middle / pole <= 0.8
    assert found["grasp_pixel"].tolist() == [14, 14]
    harness.mass[0] = 0.9
    harness.observe(segments)
    assert harness.result("grasp_pixel").tolist() == np.rint(found["midpoint"]).astype(int).tolist() != [14, 14]
    harness.mass[0] = 0.8
    harness.observe(segments)
    assert harness.result("grasp_pixel").tolist() == [14, 14]


def test_a_hole_moves_the_pole_off_the_centroid(harness):
    segments = empty()
    segments[4:45, 10:51] = 1
    segments[22:27, 28:33] = 0
    harness.observe(segments)
    found = candidates(harness)
    assert found["centroid"].tolist() == [30.0, 24.0]
    assert found["distances"][1] == 0.0
    assert found["pole"].tolist() != [30.0, 24.0]
    assert harness.image("distance")[tuple(found["grasp_pixel"][::-1])] > 0.8 * found["distances"][0]


def test_hidden_instances_have_no_grasp_point(harness):
    segments = empty()
    segments[4:9, 4:9] = 2
    harness.observe(segments)
    harness.observe(empty())
    for instance in range(2):
        assert harness.result("grasp_pixel", instance).tolist() == [-1, -1]
        assert [harness.result(name, instance) for name in ("visible", "visible_fraction", "depth")] == [0, 0.0, 0.0]
        assert len(harness.contour(instance)) == 0


def test_results_do_not_depend_on_the_previous_observation(harness):
    large, small = empty(), empty()
    large[4:40, 4:40], small[40:45, 50:57] = 1, 1
    fresh = SegmenterHarness(harness.images.scene.device, WIDTH, HEIGHT, instances=2)
    fresh.observe(small)
    harness.observe(large)
    harness.observe(small)
    for name in ("visible", "visible_fraction", "pole", "centroid", "midpoint", "distances", "grasp_pixel", "depth"):
        assert harness.result(name).tolist() == fresh.result(name).tolist()


@given(seed=st.integers(0, 2**32 - 1), mass=st.sampled_from([0.1, 1.0]))
def test_same_as_reference(seed, mass, shared):
    harness, segments = shared, blob(seed)
    harness.mass[:] = mass
    harness.observe(segments)
    labels = perception.label_components(segments, 2)
    mask = labels == perception.largest_label(labels, segments, 0)
    expected = perception.choose_grasp_point(mask, mass, harness.config.perception)
    found = candidates(harness)
    assert found["pole"].tolist() == expected["pole"].tolist()
    np.testing.assert_allclose(found["centroid"], expected["centroid"], atol=1e-5)
    # Rounding may assign a point that lies between two pixels to either.
    parts = np.concatenate([expected["centroid"], expected["midpoint"]]) % 1.0
    if (np.abs(parts - 0.5) > 1e-4).all():
        np.testing.assert_allclose(found["distances"], expected["distances"], rtol=1e-6)
        assert found["grasp_pixel"].tolist() == expected["grasp_pixel"].tolist()


@given(seed=st.integers(0, 2**32 - 1))
def test_pole_is_within_a_pixel_of_the_exact_distance_transform(seed, shared):
    """The pole is a maximum of OpenCV's distance transform, within a pixel, and its distance equals that maximum."""
    harness, segments = shared, blob(seed)
    harness.observe(segments)
    labels = perception.label_components(segments, 2)
    mask = (labels == perception.largest_label(labels, segments, 0)).astype(np.uint8)
    exact = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    best = np.argwhere(exact > exact.max() - 1e-3)[:, ::-1]
    assert np.linalg.norm(best - harness.result("pole"), axis=1).min() <= 1.0
    assert harness.result("distances")[0] == pytest.approx(exact.max(), abs=1e-3)


# ---- visible fraction and depth ----


def test_visible_fraction_of_a_sheet_is_its_area_over_the_expected_area(harness):
    """Half of the expected area is visible, at a distance of 1.5 m."""
    segments = empty()
    segments[8:28, 10:40] = 1
    fx, fy = harness.focal
    harness.area[0] = 2.0 * (30 * 1.5 / fx) * (20 * 1.5 / fy)
    harness.observe(segments, depth=1.5)
    assert harness.result("visible_fraction") == pytest.approx(0.5, rel=1e-5)
    assert harness.result("depth") == 1.5


def test_visible_fraction_sums_the_depths_of_the_largest_component_alone(harness):
    rng = np.random.default_rng(5)
    segments = blob(5)
    segments[0, 0] = 1
    depth = rng.uniform(0.5, 3.0, segments.shape).astype(np.float32)
    harness.observe(segments, depth=depth)
    labels = perception.label_components(segments, 2)
    inside = labels == perception.largest_label(labels, segments, 0)
    fx, fy = harness.focal
    assert inside.sum() < (segments == 1).sum()
    assert harness.result("visible_fraction") == pytest.approx((depth[inside].astype(float) ** 2).sum() / (fx * fy) / 0.01, rel=1e-6)
    column, row = harness.result("grasp_pixel")
    assert harness.result("depth") == depth[row, column]


def test_a_batch_without_worlds_writes_nothing(device):
    harness = SegmenterHarness(device, WIDTH, HEIGHT, worlds=2)
    harness.observe(worlds=[])
    assert (harness.observation.grasp_pixel.numpy() == 0).all()
