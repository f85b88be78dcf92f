"""Supersampled shading of narrow images: where its points lie, when it is used, and that it comes nearer to a pixel's mean."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import FAST, UNOCCLUDED
from synpick_warp.kernels.render.lighting.shading import MAX_WEIGHT_CHANGE, move_weights, shade_kernel, shade_samples_kernel, sum_of
from synpick_warp.kernels.render.visibility.triangles import Triangle, edge_areas
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.render import denoised
from tests.harness.probe import probe
from tests.worlds.toy_scene import WHITE, ToyScene, ball, camera, entry, render, sheet, surface, with_render

WIDTH, HEIGHT, FINE = 64, 48, 8
"""Image size, and the number of pixels of a finer image along one of its pixels."""
TILTED = (0.0, 0.0, 0.0, np.sin(0.5), 0.0, 0.0, np.cos(0.5))
"""Pose of a body that is turned by 1 rad about the image's x axis."""
STRIPES = EnvironmentMap(
    "stripes", np.broadcast_to(np.where(np.arange(64) // 2 % 2, 1.5, 0.5)[:, None, None], (64, 128, 3)).astype(np.float32)
)
"""Sky with horizontal stripes, six degrees wide."""


@wp.func
def move_to_ray(triangle: Triangle, ray: wp.vec3, center_ray: wp.vec3, center: wp.vec3):
    """Weights of the point where a ray of depth 1 meets its triangle's plane, and the fraction of the way from `center`."""
    weights, fraction = move_weights(center, wp.sign(sum_of(edge_areas(triangle, center_ray))), edge_areas(triangle, ray))
    return weights, fraction


moved_weights = probe(move_to_ray)


def triangles(corners: np.ndarray) -> np.ndarray:
    """Triangles of corners (N, 3, 3), in camera axes [m]."""
    rows = np.zeros(len(corners), np.dtype(Triangle.numpy_dtype()))
    rows["a"], rows["b"], rows["c"] = corners.transpose(1, 0, 2)
    return rows


def view(scale: int = 1):
    return camera(scale * WIDTH, scale * HEIGHT, scale * 200.0, (0.0, 0.0, 2.0))


def radiance_of(mesh, material, pose, device, scale=1) -> np.ndarray:
    scene = ToyScene([entry(mesh, material)], [[(0, pose)]], (view(scale),), lights=(STRIPES,))
    return render(scene, device).radiance[0]


@pytest.mark.parametrize(
    ("settings", "width", "histories", "expected"),
    [
        ({}, 320, 3, True),
        ({}, 959, 3, True),
        ({}, 960, 3, False),
        ({}, 1920, 3, False),
        ({"coarse_pixel": 1}, 1920, 3, True),
        ({"coarse_pixel": 2}, 320, 3, False),
        ({"mode": UNOCCLUDED}, 320, 0, False),
        ({"mode": FAST}, 320, 0, True),
    ],
)
def test_images_whose_coarse_pixels_are_pixels_are_supersampled(settings, width, histories, expected):
    assert denoised.supersamples(with_render(**settings).render, width, histories) == expected


def test_points_lie_on_the_plane_of_the_triangle(device):
    """Against float64: random triangles before the camera, rays near their middles; some triangles are narrower than the offset."""
    random = np.random.default_rng(6)
    count = 400
    size = 10.0 ** random.uniform(-4.0, -1.0, (count, 1, 1))
    corners = np.array([0.1, -0.05, 1.0]) + random.normal(size=(count, 3, 3)) * size
    middle = random.dirichlet((1.0, 1.0, 1.0), count)
    point = np.einsum("nk,nkd->nd", middle, corners)
    ray = point / point[:, 2:] + np.c_[random.uniform(-1e-3, 1e-3, (count, 2)), np.zeros(count)]
    weights, fraction = moved_weights(triangles(corners), ray, point / point[:, 2:], middle, device=device)
    on_plane = np.linalg.solve(corners.transpose(0, 2, 1), ray[..., None])[..., 0]
    change = on_plane / on_plane.sum(1, keepdims=True) - middle
    largest = np.abs(change).max(1)
    expected = np.minimum(1.0, float(MAX_WEIGHT_CHANGE) / largest)
    facing = np.abs(np.linalg.det(corners)) > 1e-2 * size[:, 0, 0] ** 2
    assert facing.sum() > count // 2
    assert (expected[facing] < 1.0).any()
    assert (expected[facing] == 1.0).any()
    np.testing.assert_allclose(fraction[facing], expected[facing], rtol=0.02)
    np.testing.assert_allclose(weights[facing], (middle + expected[:, None] * change)[facing], atol=0.02)


@pytest.mark.parametrize(
    ("corners", "ray"),
    [
        pytest.param([(0, 0, 1), (0, 0, 2), (0, 0, 3)], (0.0, 0.0, 1.0), id="edge on"),
        pytest.param([(0, 0, 1), (1, 0, 10), (0, 1, 1)], (0.12, 0.1, 1.0), id="beyond the horizon of the plane"),
    ],
)
def test_a_ray_that_misses_the_plane_keeps_the_center(device, corners, ray):
    weights, fraction = moved_weights(triangles(np.array([corners])), ray, (0.0, 0.0, 1.0), (0.2, 0.3, 0.5), device=device)
    np.testing.assert_allclose(weights[0], (0.2, 0.3, 0.5), rtol=1e-6)
    assert fraction[0] == 0.0


def test_a_plain_flat_surface_is_the_same_with_either_kernel(device, monkeypatch):
    """All points of a matt, evenly lit plane have the same radiance, so that supersampling changes nothing."""
    matt = surface((0.5, 0.4, 0.3))
    found = radiance_of(sheet(0.4, 0.3), matt, TILTED, device)
    monkeypatch.setattr(denoised, "supersamples", lambda *_: False)
    np.testing.assert_allclose(found, radiance_of(sheet(0.4, 0.3), matt, TILTED, device), rtol=2e-3)


@pytest.mark.parametrize("shape", ["texture", "normals"])
def test_the_mean_of_a_pixel_is_approached(device, monkeypatch, shape):
    """Against the mean of FINE² pixels of a finer image: a texture of squares 1.3 px wide, and a polished ball under a sky with stripes."""
    random = np.random.default_rng(7)
    if shape == "texture":
        texture = np.repeat(np.repeat(random.integers(0, 255, (32, 32, 3)), 8, 0), 8, 1).astype(np.uint8)
        body = sheet(0.4, 0.4), surface(texture=texture), TILTED
    else:
        body = ball(0.1, 3), surface(WHITE, 1.0, 0.1), TILTED
    inner = np.s_[HEIGHT // 2 - 4 : HEIGHT // 2 + 4, WIDTH // 2 - 8 : WIDTH // 2 + 8]
    mean = radiance_of(*body, device, FINE).reshape(HEIGHT, FINE, WIDTH, FINE, 3).mean((1, 3))[inner]
    errors = []
    for kernel in (shade_samples_kernel, shade_kernel):
        monkeypatch.setattr(denoised, "shade_samples_kernel", kernel)
        errors.append(np.sqrt(np.square(radiance_of(*body, device)[inner] - mean).mean()))
    assert errors[0] < 0.7 * errors[1]
