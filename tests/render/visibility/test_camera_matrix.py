"""A real camera matrix, fx ≠ fy and cx ≠ W/2: what OpenCV projects with it lies on the rendered edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synpick_warp.scenes.types import Camera
from tests.twins.masks import masks_of_buffers
from tests.worlds.toy_scene import ToyScene, box, entry, render_gbuffer

SIZE = (0.12, 0.08, 0.05)
EDGE = 0.1
"""Largest distance of a rendered edge from the projected one [px]."""


@pytest.mark.parametrize("seed", range(3))
def test_the_edges_of_a_box_are_where_opencv_projects_them(device, seed):
    rng = np.random.default_rng(seed)
    matrix = np.array([[275.0, 0.0, 163.8], [0.0, 254.6, 97.5], [0.0, 0.0, 1.0]])
    rotation = Rotation.from_euler(
        "xyz", [180 + rng.uniform(-15, 15), rng.uniform(-15, 15), rng.uniform(-90, 90)], degrees=True
    ).as_matrix()
    camera = Camera(320, 240, matrix, rotation, -rotation @ np.array([0.0, 0.0, 0.5]))
    turn = Rotation.from_rotvec(rng.normal(size=3))
    place = (0.02, -0.03, 0.05, *turn.as_quat())
    out, _ = render_gbuffer(ToyScene([entry(box(*SIZE))], [[(0, place)]], (camera,)), device)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = turn.apply(signs * SIZE / 2) + place[:3]
    points, _ = cv2.projectPoints(corners, cv2.Rodrigues(rotation)[0], camera.translation, matrix, None)
    hull = cv2.convexHull(points.astype(np.float32))
    inside = np.array([[cv2.pointPolygonTest(hull, (column + 0.5, row + 0.5), True) for column in range(320)] for row in range(240)])
    mask = masks_of_buffers(out)[0, 0]
    np.testing.assert_array_equal(mask[np.abs(inside) > EDGE], inside[np.abs(inside) > EDGE] > 0.0)
    assert mask.sum() > 500
