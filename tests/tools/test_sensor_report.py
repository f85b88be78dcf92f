"""Report on the depth sensor: noise, alignment and holes that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.configs.cell.sensors import DepthSensor
from tools.reports.real_frames import RealFrame
from tools.reports.sensor.alignment import align, robust_deviation
from tools.reports.sensor.cross_validation import GRAZING, cross_validate, fit_angle, predict_deviation
from tools.reports.sensor.measure import Samples, correlation, fit_noise, ring_holes
from tools.reports.sensor.pictures import draw_comparison
from tools.reports.sensor.scene import RealScenes, annotated_poses, fit_plane

FOCAL, BRICK = 120.0, 21
IDEAL = DepthSensor(noise=0.0, noise_growth=0.0, noise_angle=0.0, lateral_noise=0.0, disparity_step=1e-4, edge_width=0, shadows=False)


def frame_of(depth: np.ndarray, label: np.ndarray) -> RealFrame:
    """A foam brick, 0.55 m before the camera, turned."""
    matrix = np.array([[FOCAL, 0.0, 40.0], [0.0, FOCAL, 30.0], [0.0, 0.0, 1.0]])
    turn = np.array([[0.8, 0.0, 0.6], [0.36, 0.8, -0.48], [-0.48, 0.6, 0.64]])
    color = np.zeros((*depth.shape, 3), np.uint8)
    place = np.array([[5.0, -5.0, 550.0]])
    return RealFrame(0, 1, color, depth.astype(np.uint16), label, matrix, np.eye(4)[:3], (BRICK,), turn[None], place)


@pytest.fixture(scope="module")
def scene(real_models):
    """A frame whose depth is the rendered one: the brick, and a plane at 0.7 m."""
    blank = frame_of(np.full((60, 80), 7000), np.zeros((60, 80), np.uint8))
    scenes = RealScenes([blank], real_models)
    rendered = scenes.render([annotated_poses(blank)], IDEAL)
    scenes.frames = (replace(blank, depth=rendered.sensor[0], label=np.uint8(BRICK * (rendered.owner[0] == 0))),)
    return scenes, rendered


def test_the_plane_is_that_of_the_surroundings(scene):
    normal, height = fit_plane(scene[0].frames[0])
    np.testing.assert_allclose(normal, (0.0, 0.0, -1.0), atol=1e-3)
    assert height == pytest.approx(-0.7, abs=1e-3)


def test_a_moved_pose_is_aligned_to_its_depth(scene):
    scenes, _ = scene
    true = annotated_poses(scenes.frames[0])
    moved = true.copy()
    moved[0, :3, 3] += (0.001, -0.001, 0.003)
    (found,) = align(scenes, [moved])
    assert np.abs(found[0, :3, 3] - true[0, :3, 3]).max() < 4e-4


def test_noise_is_divided_into_axial_and_lateral():
    rng = np.random.default_rng(1)
    angle, depth = rng.uniform(5.0, 75.0, 60000), rng.uniform(0.5, 1.2, 60000)
    axial = rng.normal(size=60000) * 2.0 * depth**2
    lateral = rng.normal(size=60000) * 1e3 * depth * np.tan(np.radians(angle)) * 0.8 / 1000.0
    samples = Samples(axial + lateral, depth, angle, np.full(60000, 9.0), np.zeros(60000), np.ones(60000))
    assert fit_noise(samples, 1000.0) == pytest.approx((2.0, 0.8), rel=0.1)
    assert predict_deviation(samples, 1000.0, 2.0, 0.8) == pytest.approx(robust_deviation(samples.scaled), rel=0.03)


def test_the_grazing_angle_is_interpolated():
    rates = [10.0 - step for step in range(len(GRAZING))]
    assert fit_angle(rates, 8.5) == pytest.approx((GRAZING[1] + GRAZING[2]) / 2.0)
    assert fit_angle(rates, 99.0) == GRAZING[0]


def test_one_sequence_has_no_cross_validation(scene):
    assert cross_validate(scene[0], [annotated_poses(scene[0].frames[0])], IDEAL) == []


def test_holes_and_pictures_of_equal_depth_are_equal(scene):
    scenes, rendered = scene
    frames, counts = scenes.frames, rendered.sensor.copy()
    counts[0, :, :40] = 0
    assert ring_holes(frames, rendered, list(rendered.sensor), [0]) == 0.0
    assert 0.2 < ring_holes(frames, rendered, list(counts), [0]) < 0.8
    noise = np.random.default_rng(2).normal(0.0, 30.0, counts.shape)
    assert abs(correlation(frames, rendered, list(np.uint16(rendered.sensor + noise)), [0])[1]) < 0.2
    picture = draw_comparison(frames[0], counts[0])
    assert picture.shape == (120, 160, 3)
    assert (picture[60:, :40] == 0).all()
    assert (picture[60:, 41:80] == 255).all()
    # Holes of the simulated image alone are blue.
    assert (picture[60:, 80:120] == (230, 130, 40)).all()
