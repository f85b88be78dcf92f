"""Shading: textures, environment lighting, shadows, exposure; the precomputed tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.assets.appearance import linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages import launch
from synpick_warp.stages.render.light_tables import precompute_environment, prefilter_specular, sh_basis
from synpick_warp.stages.render.scene import mip_levels, uv_density
from synpick_warp.stages.render.view_setup import make_views
from tests.worlds.toy_scene import (
    FLAT,
    GREY,
    UPRIGHT,
    ToyScene,
    ball,
    box,
    build_scene,
    camera,
    entry,
    even_light,
    render,
    sheet,
    sun,
    surface,
    with_render,
)

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
EVEN = even_light()


def shown(material, device, *, mesh=None, lights=(EVEN,), view=VIEW, pose=FLAT, **more):
    return render(ToyScene([entry(mesh or sheet(0.4, 0.3), material)], [[(0, pose)]], (view,), lights=lights, **more), device)


def test_texture_is_upright_and_not_mirrored(device):
    # Row 0 of the image is v = 1, the sheet's +y edge, the image's upper edge: red green / blue white.
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[:4, :4], texture[:4, 4:], texture[4:, :4], texture[4:, 4:] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
    color = shown(surface(texture=texture), device).color[0]
    assert [int(np.argmax(color[row, column])) for row, column in ((17, 22), (17, 42), (31, 22))] == [0, 1, 2]
    assert color[31, 42].min() > 100


def test_fine_texture_is_averaged_in_linear_light(device):
    texture = np.zeros((512, 512, 3), np.uint8)
    texture[::2, ::2] = texture[1::2, 1::2] = 255
    picture = shown(surface(texture=texture), device)
    plain = shown(surface(color=(float(linear_to_srgb(0.5)),) * 3), device)
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


def test_one_ev_doubles_the_light_before_the_tone_curve(device):
    # Linear albedo 0.1 shows 0.125 plus the specular part; twice that is still below the shoulder.
    grey = surface((float(linear_to_srgb(0.1)),) * 3)
    plain, more = (shown(grey, device, light_exposure=ev).color[0, 24, 32] / 255.0 for ev in (0.0, 1.0))
    np.testing.assert_allclose(srgb_to_linear(more), 2.0 * srgb_to_linear(plain), rtol=0.02)
    same = shown(grey, device, light_exposure=0.5, config=with_render(exposure=2.0**-0.5)).color[0, 24, 32] / 255.0
    np.testing.assert_allclose(same, plain, atol=1.01 / 255.0)


def test_grey_sheet_has_the_analytic_brightness(device):
    # Linear albedo 0.2 under a uniform map: 0.2 x 1.25 of white, below the shoulder of the tone curve, plus the specular part.
    value = shown(surface((float(linear_to_srgb(0.2)),) * 3), device).color[0, 16:32, 22:42].mean(axis=(0, 1))
    assert (value >= np.rint(255 * linear_to_srgb(0.25)) - 1).all()
    assert (value <= np.rint(255 * linear_to_srgb(0.31))).all()


def test_rendering_is_reproducible_and_finite(device):
    mirror = entry(ball(0.05, 3), replace(GREY, metallic=1.0, roughness=0.0))
    toy = ToyScene([entry(box(0.1, 0.1, 0.1)), mirror], [[(0, FLAT), (1, (0.1, 0.0, 0.0, *UPRIGHT))]], (VIEW,))
    toy.lights, toy.table, toy.fixtures_visible = (sun((0.3, 0.2, 0.8)),), True, (1, 1, 1)
    first, second = render(toy, device), render(toy, device)
    assert np.isfinite(first.radiance).all()
    assert (first.radiance >= 0.0).all()
    np.testing.assert_array_equal(first.color, second.color)


@pytest.mark.parametrize("black", [0.0, 1e-6])
def test_black_map_renders_finite_values(device, black):
    picture = shown(GREY, device, lights=(even_light(black),))
    assert np.isfinite(picture.radiance).all()


def shadow_scene(direction, yaw=0.0, occluder=True):
    """A large sheet and, with `occluder`, a small one 0.1 m above its middle, under a sun."""
    above = [(1, (0.0, 0.0, 0.1, *UPRIGHT))] if occluder else []
    toy = ToyScene([entry(sheet(0.6, 0.4)), entry(sheet(0.08, 0.08))], [[(0, FLAT), *above]], (VIEW,))
    toy.lights, toy.light_yaw, toy.config = (sun(direction),), yaw, with_render(coarse_paths=32)
    return toy


def test_shadow_falls_away_from_the_sun(device):
    # The sun stands at 45° over +x, so the shadow of a sheet at a height of 0.1 m lies 0.1 m, 10 px, towards -x.
    lit = render(shadow_scene((1.0, 0.0, 1.0)), device).radiance[0, :, :, 0]
    assert lit[24, 22] < 0.65 * lit[24, 42]
    np.testing.assert_allclose(lit[24, 42], lit[24, 50], rtol=0.02)
    unshadowed = render(shadow_scene((1.0, 0.0, 1.0), occluder=False), device).radiance[0, :, :, 0]
    np.testing.assert_allclose(unshadowed[24, 22], lit[24, 42], rtol=0.02)


def test_environment_yaw_rotates_the_shadow(device):
    # A quarter turn counter-clockwise: the sun stands over +y, the image's upper edge, and the shadow falls to the lower one.
    lit = render(shadow_scene((1.0, 0.0, 1.0), yaw=np.pi / 2), device).radiance[0, :, :, 0]
    assert lit[34, 32] < 0.65 * lit[14, 32]
    np.testing.assert_allclose(lit[24, 22], lit[24, 42], rtol=0.02)


def test_walls_occlude_the_ground_between_them(device):
    walls = [(1, (x, 0.0, 0.05, *UPRIGHT)) for x in (0.03, -0.03)]
    toy = ToyScene([entry(sheet(0.6, 0.4)), entry(box(0.01, 0.2, 0.1))], [[(0, FLAT), *walls]], (VIEW,))
    lit = render(toy, device).radiance[0, :, :, 0]
    assert lit[24, 32] < 0.8 * lit[24, 60]


def test_denoised_plane_shows_no_sampling_pattern(device):
    # Wide filter kernels make a plane beside a wall smooth: the remaining noise has no edges. Two steps of 255 are hardly visible.
    toy = ToyScene([entry(sheet(1.0, 1.0)), entry(box(0.01, 2.0, 0.2))], [[(0, FLAT), (1, (0.25, 0.0, 0.1, *UPRIGHT))]], (VIEW,))
    toy.config = with_render(coarse_paths=8)
    lit = render(toy, device).radiance[0, 8:40, 8:40, 0]
    assert np.abs(np.diff(lit, axis=0)).max() < 2.0 / 255.0


def test_rendering_does_not_depend_on_the_number_of_threads(device, monkeypatch):
    toy = shadow_scene((1.0, 0.5, 1.0))
    monkeypatch.setattr(launch, "_cores", lambda: 1)
    one = render(toy, device)
    monkeypatch.setattr(launch, "_cores", lambda: 2)
    monkeypatch.setattr(launch, "CPU_PIECE_PIXELS", 256)
    two = render(toy, device)
    for name in ("color", "depth", "instance", "amodal"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_sh_irradiance_of_a_uniform_map():
    coefficients = precompute_environment(even_light(3.0), None).irradiance
    normals = np.random.default_rng(0).normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(sh_basis(normals) @ coefficients, 3.0 * np.pi, rtol=1e-3)


def test_sh_irradiance_of_a_gradient():
    # Radiance 1 + z: E(n) = π + 2π/3 n_z.
    directions, _ = map_directions(64)
    radiance = np.repeat((1.0 + directions[..., 2:]).astype(np.float32), 3, axis=2)
    coefficients = precompute_environment(EnvironmentMap("gradient", radiance), None).irradiance
    np.testing.assert_allclose(sh_basis(np.array([0.6, 0.0, 0.8])) @ coefficients, np.pi + 2 * np.pi / 3 * 0.8, rtol=2e-3)


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
