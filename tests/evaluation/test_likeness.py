"""Likeness of objects in images and twins: known distances of colours, order of changes, and small or empty masks."""

import numpy as np
import pytest

from synpick_warp.apps.evaluation.twins import (
    Appearance,
    Likeness,
    average,
    compare_appearance,
    compare_geometry,
    compare_objects,
    find_features,
    measure_appearance,
)

WHOLE = np.ones((40, 40), bool)


@pytest.fixture
def image() -> np.ndarray:
    """Grey noise around a gradient of colours."""
    ramp = np.linspace(60, 180, 40)[None, :, None] * np.array([1.0, 0.8, 0.6])
    return (ramp + np.random.default_rng(0).integers(-20, 20, (40, 40, 1))).astype(np.uint8)


def appearance(one: np.ndarray, other: np.ndarray, mask: np.ndarray = WHOLE) -> float:
    return compare_appearance(find_features(one)[mask], find_features(other)[mask])


def even(*color: int) -> np.ndarray:
    return np.broadcast_to(np.array(color, np.uint8), (40, 40, 3)).copy()


def test_appearance_of_known_pixels():
    color = np.zeros((40, 40, 3), np.uint8)
    color[:, 20:] = 255, 0, 0
    features = find_features(color)
    assert measure_appearance(features[WHOLE])[:2] == pytest.approx((1 / 6, 1 / 6))
    assert measure_appearance(features[WHOLE]).saturation == pytest.approx(0.5)
    assert measure_appearance(features[:, 31:].reshape(-1, 6)) == pytest.approx(Appearance(1 / 3, 0.0, 1.0, 0.0), abs=1e-5)


def test_the_same_pixels_are_alike(image):
    assert appearance(image, image) == pytest.approx(1.0, abs=1e-4)
    assert appearance(even(9, 9, 9), even(9, 9, 9)) == pytest.approx(1.0, abs=1e-4)


def test_distance_of_colours_is_that_of_wasserstein():
    """Black and white are 100 apart, so wholly different. Half of the pixels black and half white have a standard deviation of 50, so that
    they are sqrt(50² + 50²) from black and as far from white, in colour alone."""
    halves = even(0, 0, 0)
    halves[:, 20:] = 255
    assert appearance(even(0, 0, 0), even(255, 255, 255)) == pytest.approx(0.0, abs=1e-4)
    pixels, black = find_features(halves)[WHOLE], find_features(even(0, 0, 0))[WHOLE]
    pixels[:, 2] = black[:, 2] = 0.0
    assert compare_appearance(pixels, black) == compare_appearance(black, pixels) == pytest.approx(1.0 - 0.5**0.5, abs=1e-3)


def test_tint_and_blur_lower_the_appearance_step_by_step(image):
    tinted = [np.clip(image * np.array([1.0, 1.0 - step, 1.0 - step]), 0, 255).astype(np.uint8) for step in (0.0, 0.1, 0.3, 0.6, 0.9)]
    values = [appearance(image, each) for each in tinted]
    assert values == sorted(values, reverse=True)
    assert len(set(values)) == 5
    flat = image.copy()
    flat[:] = image.mean(axis=0).astype(np.uint8)
    assert appearance(image, (0.5 * image + 0.5 * flat).astype(np.uint8)) > appearance(image, flat) > 0.0


def test_a_shift_lowers_the_geometry_step_by_step():
    rendered, depth = np.zeros((40, 40), bool), np.zeros((40, 40))
    rendered[10:20, 10:20] = True
    depth[rendered] = 0.5
    masks = [np.roll(rendered, step, axis=1) for step in (0, 1, 5, 10)]
    values = [compare_geometry(rendered, depth, mask, None, 0.01) for mask in masks]
    assert values == pytest.approx([1.0, 0.9, 0.5, 0.0])
    measured = np.where(np.arange(40)[:, None] < 15, depth + 0.009, depth + 0.011)
    assert compare_geometry(rendered, depth, masks[1], measured, 0.01) == pytest.approx(0.5 * 0.9)
    assert compare_geometry(rendered, depth, None, measured, 0.01) == pytest.approx(0.5)
    assert compare_geometry(rendered, depth, None, 0.0 * measured, 0.01) == compare_geometry(rendered, depth, None, measured, None) == 1.0


def test_empty_masks_and_single_pixels(image):
    one, none = np.zeros((2, 40, 40), bool)
    one[20, 20] = True
    assert compare_geometry(none, 0.0 * one, none, None, 0.01) == compare_geometry(none, 0.0 * one, one, None, 0.01) == 0.0
    assert appearance(image, image, one) == pytest.approx(1.0, abs=1e-4)
    assert 0.0 < appearance(image, 255 - image, one) < 1.0
    features = find_features(image)
    assert compare_objects(7, features[none], features[none], 0.5) == Likeness(7, None, None, 0.0, 0.5, 0.0)
    found = compare_objects(7, features[one], features[one], 0.5)
    assert found.score == found.appearance * 0.5
    (mean,) = average([found, compare_objects(7, features[none], features[none], 0.0)])
    assert (mean.image, mean.geometry) == (found.image, 0.25)
    assert average([]) == []
