"""Lens models against OpenCV's projections, and the properties that the renderer's bounds rely on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from synpick_warp.configs.calibration.lens import FISHEYE, MAX_ANGLE, PINHOLE, TOLERANCE, Lens, LensMap
from synpick_warp.errors import ConfigError

LENSES = {
    "issue": (PINHOLE, (275.0, 274.6, 163.8, 117.5), (-0.12, 0.08, 0.0005, -0.0003, 0.0), (320, 240)),
    "four": (PINHOLE, (275.0, 274.6, 163.8, 117.5), (-0.1, 0.03, 0.001, -0.002), (320, 240)),
    "webcam": (PINHOLE, (600.0, 600.0, 640.0, 360.0), (-0.35, 0.12, 0.0, 0.0, 0.0), (1280, 720)),
    "rational": (PINHOLE, (600.0, 600.0, 640.0, 360.0), (8.5, 3.2, 1e-3, -5e-4, 0.15, 8.8, 4.8, 0.6), (1280, 720)),
    "prism": (PINHOLE, (300.0, 290.0, 320.0, 180.0), (-0.2, 0.05, 2e-3, -3e-3, 0, 0.01, 0.02, 0, 0.01, -2e-3, 5e-3, 1e-3), (640, 360)),
    "pole beside the image": (PINHOLE, (600.0, 600.0, 640.0, 360.0), (0, 0, 0, 0, 0, -0.5, 0, 0), (1280, 720)),
    "fisheye": (FISHEYE, (300.0, 301.0, 320.0, 240.0), (-0.01, 0.02, -0.01, 0.002), (640, 480)),
    "none": (PINHOLE, (300.0, 301.0, 320.0, 240.0), (0.0,) * 4, (640, 480)),
}
number = st.floats(-1, 1)


def opencv_projection(model, intrinsics, coefficients, points):
    """Pixels of points (n, 2) of the normalised plane by OpenCV, with pixel centres where the matrix has them."""
    fx, fy, cx, cy = intrinsics
    project = cv2.fisheye.projectPoints if model == FISHEYE else cv2.projectPoints
    there = np.column_stack((points, np.ones(len(points)))).reshape(-1, 1, 3)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return project(there, np.zeros(3), np.zeros(3), matrix, np.array(coefficients, float))[0].reshape(-1, 2)


@st.composite
def maps(draw):
    """Lenses of all models, and images that they cover."""
    model, count = draw(st.sampled_from([(PINHOLE, 4), (PINHOLE, 5), (PINHOLE, 8), (PINHOLE, 12), (FISHEYE, 4)]))
    sizes = (0.1,) * 4 if model == FISHEYE else (0.5, 0.3, 0.01, 0.01, 0.2, 0.5, 0.2, 0.1, 0.01, 0.01, 0.01, 0.01)[:count]
    coefficients = tuple(draw(number) * size for size in sizes)
    focal = 100 * draw(st.floats(1, 20))
    intrinsics = (focal, focal * (1 + draw(number) / 20), 50 + 20 * draw(number), 40 + 20 * draw(number))
    try:
        return model, intrinsics, coefficients, LensMap(Lens(model, coefficients), intrinsics, (100, 80))
    except ConfigError:
        assume(False)


@pytest.mark.parametrize("name", LENSES)
def test_each_pixel_is_the_projection_of_its_ray(name):
    model, intrinsics, coefficients, size = LENSES[name]
    lens = LensMap(Lens(model, coefficients), intrinsics, size)
    pixels = np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), -1)
    rays = lens.unproject(pixels)
    assert np.abs(lens.project(rays) - pixels).max() < TOLERANCE
    some = tuple(np.unique(np.linspace(0, side - 1, 160, dtype=int)) for side in rays.shape[:2])
    few, there = (each[np.ix_(*some)].reshape(-1, 2) for each in (rays, pixels))
    assert np.abs(opencv_projection(model, intrinsics, coefficients, few) - there).max() < TOLERANCE
    assert np.linalg.norm(rays, axis=-1).max() <= lens.radius <= np.tan(np.radians(MAX_ANGLE))
    assert np.array_equal(lens.rays(), rays.astype(np.float32))
    assert lens.lens.is_identity == (name == "none")


@settings(max_examples=25, deadline=None)
@given(maps(), st.lists(st.tuples(number, number), min_size=1, max_size=20))
def test_projections_are_opencvs_within_the_domain(lens, places):
    model, intrinsics, coefficients, made = lens
    points = np.array(places) * made.radius / np.sqrt(2)
    np.testing.assert_allclose(made.project(points), opencv_projection(model, intrinsics, coefficients, points), rtol=1e-9, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(maps(), st.lists(st.tuples(number, number), min_size=1, max_size=20))
def test_the_inverse_holds_in_the_image_and_beyond_its_domain(lens, places):
    *_, made = lens
    pixels = (50, 40) + np.array(places) * 300
    assert np.abs(made.project(made.unproject(pixels)) - pixels).max() < TOLERANCE


@settings(max_examples=25, deadline=None)
@given(maps(), st.tuples(number, number, number, number), st.floats(1e-3, 6))
def test_no_segment_is_bent_more_than_the_bound(lens, ends, size):
    """Midpoints of segments inside of the domain and across its edge; the continuation has no step in value or slope there."""
    *_, made = lens
    start, stop = np.array(ends).reshape(2, 2) * min(size, 5) * made.radius
    along = np.linspace(0, 1, 41)[:, None]
    chord = made.project(start) + along * (made.project(stop) - made.project(start))
    off = np.linalg.norm(made.project(start + along * (stop - start)) - chord, axis=-1)
    assert off.max() <= made.bend * ((stop - start) ** 2).sum() / 8 + 1e-7


@pytest.mark.parametrize("name", LENSES)
def test_undistortion_maps_are_opencvs(name):
    """In OpenCV's convention, so with half a pixel less in the matrix."""
    model, (fx, fy, cx, cy), coefficients, size = LENSES[name]
    matrix, given = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]), np.array(coefficients, float)
    make = cv2.fisheye.initUndistortRectifyMap if model == FISHEYE else cv2.initUndistortRectifyMap
    expected = make(matrix, given, np.eye(3), matrix, size, cv2.CV_32FC1)
    made = LensMap(Lens(model, coefficients), (fx, fy, cx, cy), size)
    # Beyond the domain, OpenCV folds and ours goes on; what a picture is made of lies within.
    rays = (np.stack(np.meshgrid(*(np.arange(side) for side in size)), -1) - (cx - 0.5, cy - 0.5)) / (fx, fy)
    domain = np.linalg.norm(rays, axis=-1) <= made.radius
    assert domain.mean() > 0.5
    np.testing.assert_allclose(made.undistortion_maps()[:, domain], np.array(expected)[:, domain], atol=2e-3)


REFUSED = {
    "a fold in the image": (PINHOLE, (-0.35, 0.05, 0, 0, 0), "folds over at 216 px .* corner is 400 px away"),
    "a strong fold": (PINHOLE, (-30.0, 0, 0, 0, 0), r"folds over at \d+ px"),
    "a fold by tangential coefficients": (PINHOLE, (0, 0, 30.0, 0, 0), r"folds over at \d px"),
    "a fold in front of the pole": (PINHOLE, (-3.0, 0, 0, 0, 0, -0.9, 0, 0), "folds over"),
    "rays behind the camera": (FISHEYE, (-0.2, 0.0, 0.0, 0.0), "folds over|no ray within 85°"),
    "three coefficients": (PINHOLE, (0.1, 0.1, 0.1), "3 coefficients; allowed: 4 or 5 or 8 or 12"),
    "a fisheye with five": (FISHEYE, (0.1,) * 5, "5 coefficients; allowed: 4 with the model fisheye"),
    "not a number": (PINHOLE, (0.1, float("nan"), 0, 0), "not finite"),
    "another model": ("ftheta", (0.1,) * 4, 'model "ftheta"; allowed: pinhole, fisheye'),
}


@pytest.mark.parametrize("name", REFUSED)
def test_impossible_lenses_are_refused_in_one_line(name):
    model, coefficients, message = REFUSED[name]
    with pytest.raises(ConfigError, match=message) as caught:
        LensMap(Lens(model, coefficients), (300.0, 300.0, 320.0, 240.0), (640, 480))
    assert "\n" not in str(caught.value)
