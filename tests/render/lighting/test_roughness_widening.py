"""Specular anti-aliasing: the variance of normals in a pixel widens its GGX lobe: highlights on small curved objects do not sparkle."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from synpick_warp.kernels.render.lighting.materials import MAX_WIDENING, PIXEL_VARIANCE, widen_roughness
from synpick_warp.scenes.types import Material, TriangleMesh
from synpick_warp.stages.render import scene
from synpick_warp.stages.render.scene import normal_gradient
from tests.harness.probe import probe
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, camera, entry, render, sun

RADIUS = 6.0
SHINY = Material(color=(0.9, 0.9, 0.9), texture=None, metallic=1.0, roughness=0.1)


def cylinder(radius: float) -> TriangleMesh:
    """A tube without lids, with smooth normals [m]."""
    tube = trimesh.creation.cylinder(radius=radius, height=0.2, sections=48, cap=False)
    vertices = np.asarray(tube.vertices)
    outer = np.hypot(vertices[:, 0], vertices[:, 1]) > 0.5 * radius
    faces = np.asarray(tube.faces)[outer[tube.faces].all(axis=1)]
    normals = vertices * (1.0, 1.0, 0.0) / radius
    uv = np.zeros((len(vertices), 2), np.float32)
    return TriangleMesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32), uv)


def test_normal_gradient_is_the_curvature():
    # One radian per radius along each curved direction; the norm adds both in quadrature.
    np.testing.assert_allclose(normal_gradient(ball(0.05, 2)), np.sqrt(2.0) / 0.05, rtol=1e-4)
    tube = cylinder(0.05)
    assert len(tube.faces) == 96
    np.testing.assert_allclose(normal_gradient(tube), 1.0 / 0.05, rtol=1e-4)
    np.testing.assert_allclose(normal_gradient(box(0.1, 0.2, 0.3)), 0.0, atol=1e-5)


def test_degenerate_triangles_have_no_normal_gradient():
    flat = ball(0.05, 0)
    flat.faces[0] = flat.faces[0][[0, 0, 1]]
    assert normal_gradient(flat)[0] == 0.0


widen = probe(widen_roughness)


def test_squared_widths_add_up_to_max_widening(device):
    roughness, spread = (grid.ravel().astype(np.float32) for grid in np.meshgrid(np.linspace(0.0, 1.0, 11), [0.0, 1e-3, 0.1, 1.0, 100.0]))
    widened = widen(roughness, spread, device=device)
    added = np.minimum(float(PIXEL_VARIANCE) * spread.astype(np.float64) ** 2, float(MAX_WIDENING))
    np.testing.assert_allclose(widened, np.minimum(roughness.astype(np.float64) ** 4 + added, 1.0) ** 0.25, atol=2e-6)


def brightness_while_moving(device, light) -> np.ndarray:
    """Mean radiance (8) of images of a metal ball, of radius RADIUS px, that moves by a quarter of a pixel per image."""
    view = camera(32, 24, 120.0, (0.0, 0.0, 1.0))
    means = []
    for step in range(8):
        pose = (step / 4 / 120.0, step / 9 / 120.0, 0.0, *UPRIGHT)
        toy = ToyScene([entry(ball(RADIUS / 120.0, 4), SHINY)], [[(0, pose)]], (view,), lights=(light,))
        picture = render(toy, device)
        means.append(np.where(picture.instance[0][..., None] == 1, picture.radiance[0], 0.0).mean())
    return np.array(means)


def test_subpixel_highlights_are_neither_lost_nor_sparkle(device, monkeypatch):
    rows, sky, strength = 128, 0.3, 3e4
    light = sun((0.3, 0.2, 1.0), sky, strength, rows)
    # A mirroring ball reflects light uniformly: in each direction a quarter of what its disc receives.
    row = np.unravel_index(light.radiance[..., 0].argmax(), light.radiance.shape[:2])[0]
    irradiance = strength * (np.pi / rows) ** 2 * np.sin(np.pi * (row + 0.5) / rows)
    truth = 0.9 * RADIUS**2 * (irradiance / 4.0 + np.pi * sky) / (32 * 24)
    steady = brightness_while_moving(device, light)
    assert steady.mean() == pytest.approx(truth, rel=0.12)
    assert np.abs(steady / truth - 1.0).max() < 0.35
    monkeypatch.setattr(scene, "normal_gradient", lambda mesh: np.zeros(len(mesh.faces), np.float32))
    # Without it, most images lose the highlight, and it sparkles in the others.
    sparkling = brightness_while_moving(device, light) / truth
    assert np.median(sparkling) < 0.6
    assert sparkling.max() > 1.5
