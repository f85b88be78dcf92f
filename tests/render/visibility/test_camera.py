"""Pixel tiles, camera rays, projected boxes."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.kernels.render.visibility.camera import CameraTable, ImageGrid, in_image, pinhole_ray, projected_box, tile_pixel
from synpick_warp.stages.render.scene import build_grid
from tests.harness.devices import default_device
from tests.harness.probe import probe
from tests.twins.raycast import rotation_of

WIDTH, HEIGHT, FOCAL = 160, 90, 200.0


@wp.func
def visit_pixel(grid: ImageGrid, visits: wp.array3d[int], index: int):
    view, row, column = tile_pixel(grid, index)
    if in_image(grid, row, column):
        wp.atomic_add(visits, view, row, column, 1)


visit, ray_of, box_of = probe(visit_pixel), probe(pinhole_ray), probe(projected_box, cameras=CameraTable)


def project(lower, upper, rotation, position):
    cameras = CameraTable()
    cameras.intrinsics = wp.array([(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)], dtype=wp.vec4, device=default_device())
    return box_of(lower, upper, rotation, position, cameras, 0, build_grid(WIDTH, HEIGHT))


@pytest.mark.parametrize(("width", "height"), [(8, 4), (1, 1), (33, 17), (7, 9)])
def test_tiles_visit_every_pixel_once(width, height):
    grid = build_grid(width, height)
    visits = wp.zeros((2, height, width), dtype=int, device=default_device())
    visit(grid, visits, np.arange(2 * grid.tiles * 32))
    assert (visits.numpy() == 1).all()


def test_rays_pass_pixel_centres():
    rays = ray_of((10.0, 20.0, 1.5, 1.0), *np.indices((2, 3)), (0.0, 0.0))
    np.testing.assert_allclose(rays[0, 0], [-1.0 / 10.0, -0.5 / 20.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(rays[1, 2], [1.0 / 10.0, 0.5 / 20.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(rays[0, 1][0], 0.0, atol=1e-7)
    rays = ray_of((10.0, 20.0, 1.5, 1.0), *np.indices((2, 3)), (0.5, -0.5))
    np.testing.assert_allclose(rays[0, 0], [-0.5 / 10.0, -1.0 / 20.0, 1.0], rtol=1e-6)


def test_a_box_straight_ahead_has_a_known_projection():
    # Half a width of 0.1 m at 1 m is 20 px; the nearest face decides; one pixel of margin.
    assert project((-0.1, -0.1, 0.0), (0.1, 0.1, 1.0), np.eye(3), (0, 0, 1.0)).tolist() == [59, 24, 101, 66]


def test_a_box_behind_the_camera_is_empty_and_one_that_crosses_it_covers_the_canvas():
    assert project((-0.1,) * 3, (0.1,) * 3, np.eye(3), (0, 0, -1.0)).tolist() == [0, 0, -1, -1]
    assert project((-0.1,) * 3, (0.1,) * 3, np.eye(3), (0, 0, 0.05)).tolist() == [-160, -90, 319, 179]


def test_a_box_beyond_the_canvas_is_empty():
    assert project((-0.1,) * 3, (0.1,) * 3, np.eye(3), (5.0, 0, 1.0)).tolist() == [0, 0, -1, -1]
    assert project((-0.1,) * 3, (0.1,) * 3, np.eye(3), (0, -3.0, 1.0)).tolist() == [0, 0, -1, -1]


@given(
    size=st.tuples(*[st.floats(0.001, 0.3)] * 3),
    quaternion=st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    position=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-0.3, 3.0)),
    seed=st.integers(0, 1000),
)
def test_projected_boxes_are_conservative(size, quaternion, position, seed):
    rotation = rotation_of(np.array(quaternion))
    half = np.array(size, np.float32) / 2
    left, top, right, bottom = project(-half, half, rotation, position)
    points = np.random.default_rng(seed).uniform(-1, 1, (200, 3)) * half.astype(np.float64) @ rotation.T + position
    points = points[points[:, 2] > 1e-3]
    columns = points[:, 0] / points[:, 2] * FOCAL + WIDTH / 2
    rows = points[:, 1] / points[:, 2] * FOCAL + HEIGHT / 2
    on_canvas = (columns >= -WIDTH) & (columns < 2 * WIDTH) & (rows >= -HEIGHT) & (rows < 2 * HEIGHT)
    columns, rows = columns[on_canvas], rows[on_canvas]
    assert (np.floor(columns) >= left).all()
    assert (np.floor(columns) <= right).all()
    assert (np.floor(rows) >= top).all()
    assert (np.floor(rows) <= bottom).all()
