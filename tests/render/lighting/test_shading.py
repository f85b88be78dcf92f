"""Shading: textures, environment lighting, shadows, exposure; the precomputed tables."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages import launch
from synpick_warp.stages.render.light_tables import precompute_environment, prefilter_specular, sh_basis
from synpick_warp.stages.render.scene import mip_levels, uv_density
from synpick_warp.stages.render.view_setup import make_views
from tests.worlds.toy_scene import (
    ANNOTATIONS,
    FLAT,
    GREY,
    HALF,
    UPRIGHT,
    ToyScene,
    assert_same,
    ball,
    box,
    build_scene,
    camera,
    entry,
    even_light,
    render,
    render_objects,
    sheet,
    sun,
    surface,
    with_render,
)

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))


def shown(material, device, **more):
    return render_objects(device, (sheet(0.4, 0.3), material), view=VIEW, **more)


def test_fine_texture_is_averaged_in_linear_light(device):
    texture = np.zeros((512, 512, 3), np.uint8)
    texture[::2, ::2] = texture[1::2, 1::2] = 255
    picture = shown(surface(texture=texture), device)
    plain = shown(surface(color=HALF), device)
    middle = (0, slice(15, 33), slice(18, 46))
    np.testing.assert_allclose(picture.radiance[middle], plain.radiance[middle], rtol=0.01)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (5, 3)])
def test_textures_of_any_size_render(device, size):
    # Red from left to right, as far as there are columns; green throughout.
    texture = np.zeros((*size, 3), np.uint8)
    texture[..., 0], texture[..., 1] = np.linspace(40, 200, size[1]), 120
    shown_rows = shown(surface(texture=texture), device).radiance[0, 12:36, 14:50]
    # Light is sampled without the surface's colour: its noise is the same on both.
    plain = shown(surface(color=(0.0, 120 / 255, 0.0)), device).radiance[0, 12:36, 14:50]
    # Texels are rounded to 10 bits of the square root.
    np.testing.assert_allclose(shown_rows[..., 1], plain[..., 1], rtol=2.5e-3)
    # Both colours have the same noise except for the specular part: some per cent of the light, to some per cent.
    ratio = shown_rows[..., 0] / shown_rows[..., 1]
    assert (np.ptp(ratio, axis=0) < 5e-3).all()
    assert (np.ptp(ratio) > 0.1) == (size[1] > 1)
    finest = mip_levels(texture)
    assert finest[0].shape[:2] == size
    assert finest[-1].shape[:2] == (1, 1)


def test_mip_levels_keep_the_mean_also_for_odd_sizes():
    texture = np.random.default_rng(0).integers(0, 256, (37, 50, 3), dtype=np.uint8)
    levels = mip_levels(texture)
    assert [level.shape[:2] for level in levels] == [(37, 50), (18, 25), (9, 12), (4, 6), (2, 3), (1, 1)]
    mean = srgb_to_linear(texture / 255.0).mean(axis=(0, 1))
    np.testing.assert_allclose(srgb_to_linear(levels[-1][0, 0] / 255.0), mean, atol=0.03)


def test_texture_density_is_texture_lengths_per_metre():
    np.testing.assert_allclose(uv_density(sheet(0.5, 0.5)), 2.0, rtol=1e-6)
    assert not uv_density(ball(0.1, 1)).any()


def test_exposure_depends_on_the_setting_and_not_on_the_maps_scale(device):
    dim, bright = (shown(GREY, device, lights=(even_light(s),)).color for s in (0.01, 100.0))
    assert np.abs(dim.astype(int) - bright).max() <= 1
    more = shown(GREY, device, config=with_render(exposure=1.5)).color
    assert (more.astype(int) - dim)[0, 24, 32].min() > 10


def test_denoised_plane_shows_no_sampling_pattern(device):
    # Wide filter kernels make a plane beside a wall smooth: the remaining noise has no edges. Two steps of 255 are hardly visible.
    toy = ToyScene([entry(sheet(1.0, 1.0)), entry(box(0.01, 2.0, 0.2))], [[(0, FLAT), (1, (0.25, 0.0, 0.1, *UPRIGHT))]], (VIEW,))
    toy.config = with_render(coarse_paths=8)
    lit = render(toy, device).radiance[0, 8:40, 8:40, 0]
    assert np.abs(np.diff(lit, axis=0)).max() < 2.0 / 255.0


def test_rendering_does_not_depend_on_the_number_of_threads(device, monkeypatch):
    toy = ToyScene([entry(sheet(0.6, 0.4)), entry(sheet(0.08, 0.08))], [[(0, FLAT), (1, (0.0, 0.0, 0.1, *UPRIGHT))]], (VIEW,))
    toy.lights, toy.config = (sun((1.0, 0.5, 1.0)),), with_render(coarse_paths=32)
    monkeypatch.setattr(launch, "_cores", lambda: 1)
    one = render(toy, device)
    monkeypatch.setattr(launch, "_cores", lambda: 2)
    monkeypatch.setattr(launch, "CPU_PIECE_PIXELS", 256)
    two = render(toy, device)
    assert_same(one, two, "color", *ANNOTATIONS)


@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_sh_irradiance_of_a_gradient(slope):
    """Of radiance 1 + s z: E(n) = π + s 2π/3 n_z."""
    directions, _ = map_directions(64)
    radiance = np.repeat((1.0 + slope * directions[..., 2:]).astype(np.float32), 3, axis=2)
    normals = np.random.default_rng(0).normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = sh_basis(normals) @ precompute_environment(EnvironmentMap("gradient", radiance), None).irradiance
    np.testing.assert_allclose(found, np.repeat(np.pi + slope * 2 * np.pi / 3 * normals[:, 2:], 3, axis=1), rtol=2e-3)


def test_prefiltered_maps_of_a_uniform_map_and_a_spot():
    np.testing.assert_allclose(prefilter_specular(np.full((16, 32, 3), 0.7)), 0.7, rtol=1e-6)
    spot = np.zeros((16, 32, 3))
    spot[5, 20] = 1.0
    filtered = prefilter_specular(spot)[..., 0]
    assert all(np.unravel_index(level.argmax(), level.shape)[1] == 20 for level in filtered)
    assert np.unravel_index(filtered[0].argmax(), filtered[0].shape) == (5, 20)
    assert (np.diff(filtered.max(axis=(1, 2))) < 0.0).all()


def test_a_batch_larger_than_the_scratch_is_refused(device):
    toy = ToyScene([entry(sheet(0.1, 0.1))], [[(0, FLAT)]], (VIEW,))
    scene = build_scene(toy, device)
    renderer = make_renderer(toy.settings(), scene, toy.instances, 1)
    views = make_views(None, None, 2, toy.instances)
    with pytest.raises(ValueError, match="2 views in a batch; this renderer has scratch for 1"):
        renderer.render(None, views, None)
