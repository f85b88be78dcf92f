"""Distorted cameras: the rasterizer equals the tracing of each pixel's ray and float64, edges lie where OpenCV projects them, and masks
beyond the image, flow and the undistorted picture are right."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.configs.calibration.lens import FISHEYE, with_matrix
from synpick_warp.configs.schema import UNOCCLUDED
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.render.cameras import allocate_lenses, allocate_view_cameras, place_cameras
from synpick_warp.system.hardware.device import pick_device
from tests.harness.devices import default_device
from tests.render.visibility.test_raster import NEVER, depth_in_float64, gbuffer_of, random_triangles, triangles
from tests.twins.annotate import annotated
from tests.twins.layers import PreviousFrame, render_layers
from tests.worlds.toy_scene import (
    DOWN,
    FLAT,
    UPRIGHT,
    ToyScene,
    ball,
    box,
    build_scene,
    camera,
    distorted,
    entry,
    one,
    render,
    sheet,
    surface,
    with_render,
)

WIDE = camera(96, 64, 70.0, (0.0, 0.0, 1.0))
VIEWS = {
    "issue": distorted(WIDE, -0.12, 0.08, 0.0005, -0.0003, 0.0),
    "strong": distorted(WIDE, -0.35, 0.12, 0.002, -0.003, 0.0),
    "pincushion": distorted(WIDE, 0.2, 0.05, 0.0, 0.0),
    "rational": distorted(WIDE, 8.5, 3.2, 1e-3, -5e-4, 0.15, 8.8, 4.8, 0.6),
    "prism": distorted(WIDE, -0.2, 0.05, 2e-3, -3e-3, 0.0, 0.01, 0.02, 0.0, 0.01, -2e-3, 5e-3, 1e-3),
    "fisheye": distorted(WIDE, -0.01, 0.02, -0.01, 0.002, model=FISHEYE),
}


TURN = Rotation.from_euler("xyz", [172, 9, 40], degrees=True).as_matrix()
OFF_CENTRE = Camera(96, 64, np.array([[75.0, 0.0, 51.3], [0.0, 69.4, 30.2], [0.0, 0.0, 1.0]]), TURN, -TURN @ (0.02, -0.03, 1.0))
"""A real camera matrix without a lens: fx ≠ fy and cx ≠ W/2."""


def opencv_pixels(view: Camera, points: np.ndarray) -> np.ndarray:
    """Pixel coordinates of world points (n, 3) by OpenCV with the camera's values; its pixel centres are then at + 0.5, as ours."""
    lens = view.lens and view.lens.lens
    project = cv2.fisheye.projectPoints if lens and lens.model == FISHEYE else cv2.projectPoints
    there = (points @ view.rotation.T + view.translation).reshape(-1, 1, 3)
    return project(there, np.zeros(3), np.zeros(3), view.matrix, np.array(lens.coefficients) if lens else None)[0].reshape(-1, 2)


@settings(max_examples=30, deadline=None)
@given(name=st.sampled_from(sorted(VIEWS)), seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.003, 0.03, 0.3, 2.0]))
def test_the_rasterizer_misses_no_ray(name, seed, size):
    """Triangles all over and beside the image, some through the camera's plane: their footprints bound their bent images."""
    toy, device = one(triangles(random_triangles(seed, 30, size, 0.8)), FLAT, VIEWS[name]), pick_device(default_device())
    ours, theirs = gbuffer_of(toy, device), gbuffer_of(toy, device, by_rays=True)
    differs = ours["segment"] != theirs["segment"]
    assert differs.sum() <= (2 if device.is_cuda else 0)
    # Both are float32, and depth is interpolated over two metres.
    np.testing.assert_allclose(ours["depth"][~differs], theirs["depth"][~differs], rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("size", [0.03, 0.3])
def test_depth_and_masks_are_those_of_float64(device, name, size):
    corners = random_triangles(5, 40, size, 0.4)
    found = gbuffer_of(one(triangles(corners), FLAT, VIEWS[name]), device)
    depth, clear = depth_in_float64(corners, VIEWS[name])
    sure = clear > 0.1
    assert sure.mean() > 0.4
    np.testing.assert_array_equal(found["segment"][sure] == 1, depth[sure] < NEVER)
    both = sure & (depth < NEVER)
    assert both.sum() > 20
    np.testing.assert_allclose(found["depth"][both], depth[both], rtol=2e-4)
    assert (found["amodal"][both] == 1).all()


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize(("zoom", "shift"), [(0.0, (3.0, -2.0)), (0.05, (-4.5, 0.25)), (-0.02, (0.5, 1.5))])
def test_rays_of_a_drawn_camera_matrix_are_those_of_float64(device, name, zoom, shift):
    """Beside a pinhole, in a batch of three views with a lens of their own."""
    view = VIEWS[name]
    matrix = view.matrix * (1.0 + zoom * np.eye(3))
    matrix[:2, 2], matrix[2, 2] = view.matrix[:2, 2] + shift, 1.0
    lenses = (with_matrix(view.lens, matrix), None, view.lens)
    scene = build_scene(ToyScene([entry(sheet(1.0, 1.0))], [[]], (view, WIDE)), device)
    slot, matrices = np.array([0, 1, 0], np.int32), np.array([matrix, WIDE.matrix, view.matrix])
    cameras = allocate_view_cameras(4, device, scene.cameras)
    cameras.lenses = allocate_lenses({"view": 4, "row": view.height, "column": view.width}, device)
    placed = {"matrix": matrices, "rotation": np.array([DOWN] * 3), "translation": np.zeros((3, 3))}
    place_cameras(cameras, scene.cameras, slot, placed, (view.lens, None))
    assert cameras.lens.numpy()[:3].tolist() == [0, -1, 2]
    for row in (0, 2):
        # A thousandth of a pixel is 1.5e-5 here.
        np.testing.assert_allclose(cameras.lenses.ray.numpy()[row], lenses[row].rays(), rtol=0, atol=5e-7)


@pytest.mark.parametrize("view", [*VIEWS.values(), OFF_CENTRE], ids=[*VIEWS, "off centre"])
def test_edges_lie_where_opencv_projects_them(device, view):
    """A square that fills most of the image: its mask ends within 0.02 px of the projected outline."""
    half = 0.35
    found = gbuffer_of(ToyScene([entry(sheet(2 * half, 2 * half))], [[(0, (0.05, 0.02, 0.0, *UPRIGHT))]], (view,)), device)
    side = np.linspace(-half, half, 400)
    ends = np.full_like(side, half)
    outline = np.concatenate([np.stack(p, 1) for p in ((side, -ends), (ends, side), (-side, ends), (-ends, -side))])
    places = opencv_pixels(view, np.column_stack((outline + np.array((0.05, 0.02)), np.zeros(len(outline))))).astype(np.float32)
    rows, columns = np.indices(found["segment"].shape)
    off = np.array([cv2.pointPolygonTest(places, (c + 0.5, r + 0.5), True) for r, c in zip(rows.flat, columns.flat, strict=True)])
    sure = abs(off) > 0.02
    assert sure.mean() > 0.95
    assert 1000 < (off > 0).sum() < off.size - 500
    np.testing.assert_array_equal((found["segment"].ravel() == 1)[sure], (off > 0)[sure])


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("place", [(0.68, 0.0), (-0.75, 0.45), (0.0, -0.62)])
def test_masks_beyond_the_border_are_those_of_the_continued_lens(device, name, place):
    view = VIEWS[name]
    toy = ToyScene([entry(ball(0.15, 3))], [[(0, (*place, 0.1, *UPRIGHT)), (0, (*place, -0.3, *UPRIGHT))]], (view,))
    picture, pixels, boxes = annotated(toy, device)
    assert pixels[0][0] > 50
    # The inverse is float32 here and float64 there: a ray within 1e-3 px of an outline may pass it on either side.
    assert np.abs(picture.pixels[0] - pixels).max() <= 1
    assert np.abs(picture.boxes[0] - boxes).max() <= 1


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("shift", [0.0, 1e-5, 0.03])
def test_flow_is_the_difference_of_opencvs_projections(device, name, shift):
    """Of a sheet that moves across and towards the camera, by nothing, by less than float32 resolves in pixels, and by pixels."""
    view, moved = VIEWS[name], np.array((shift, -shift / 2, shift))
    toy = ToyScene([entry(sheet(0.8, 0.5))], [[(0, (0.05, 0.02, 0.0, *UPRIGHT))]], (view,))
    before = PreviousFrame([[(0, (*(np.array((0.05, 0.02, 0.0)) - moved), *UPRIGHT))]], [1])
    rendered = render_layers(toy, device, before, names=("flow",))
    seen = rendered.segment[0] == 1
    centers = np.stack(np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5), -1)[seen]
    rays = np.column_stack((view.lens.unproject(centers), np.ones(len(centers))))
    points = (rays * rendered.depth[0][seen][:, None] - view.translation) @ view.rotation
    expected = opencv_pixels(view, points - moved) - centers
    np.testing.assert_allclose(rendered["flow"][0][seen], expected, atol=2e-3 if shift > 1e-4 else 1e-5)
    assert seen.sum() > 1000


@pytest.mark.parametrize("name", ["issue", "fisheye"])
def test_the_undistorted_picture_is_that_of_a_pinhole(device, name):
    plain = camera(640, 480, 480.0, (0.0, 0.0, 1.0))
    lens = VIEWS[name].lens.lens
    placed = [[(0, (-0.2, 0.1, 0.0, *UPRIGHT)), (1, (0.25, -0.1, 0.05, 0.1, 0.2, 0.3, 0.927))]]
    toy = ToyScene([entry(ball(0.2, 5)), entry(box(0.3, 0.2, 0.1), surface((0.6, 0.3, 0.2)))], placed, (plain,), table=True)
    toy.config = with_render(UNOCCLUDED)
    expected = render(toy, device).color[0]
    bent = distorted(plain, *lens.coefficients, model=lens.model)
    found = render(replace(toy, cameras=(bent,)), device).color[0]
    maps = bent.lens.undistortion_maps()
    flat = cv2.remap(found, *maps, cv2.INTER_CUBIC)
    inside = (maps[0] > 4) & (maps[1] > 4) & (maps[0] < 635) & (maps[1] < 475)
    error = (flat.astype(float) - expected)[inside]
    assert inside.mean() > 0.6
    assert 10 * np.log10(255**2 / np.mean(error**2)) >= 38.0
    assert np.mean((found.astype(float) - expected)[inside] ** 2) > 4 * np.mean(error**2)
