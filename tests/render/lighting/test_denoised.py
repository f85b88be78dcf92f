"""Denoised renderer: known amounts of light, and its error against the path-traced reference."""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import Catalog, EnvironmentMap
from synpick_warp.stages.buffers import allocate_view_buffers
from synpick_warp.stages.render.light_tables import precompute_environment
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tests.harness.brdf_probe import toward
from tests.worlds import toy_scene
from tests.worlds.toy_scene import (
    FLAT,
    HALF,
    UPRIGHT,
    WHITE,
    ToyScene,
    build_scene,
    camera,
    clutter,
    entry,
    even_light,
    lamp,
    psnr,
    sheet,
    snapshot,
    sun,
    surface,
    with_render,
)

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
EVEN = even_light()
render_objects = functools.partial(toy_scene.render_objects, view=VIEW)


@pytest.mark.parametrize("table", [False, True])
def test_grey_plane_under_a_uniform_map_equals_the_reference(device, table):
    plane = (sheet(0.6, 0.5), surface(HALF, 0.0, 0.7))
    denoised, reference = (
        render_objects(device, plane, table=table, config=with_render(mode, coarse_paths=16)).radiance.mean(axis=(0, 1, 2))
        for mode in (FAST, REFERENCE)
    )
    np.testing.assert_allclose(denoised, reference, rtol=0.01)
    np.testing.assert_allclose(denoised, 0.5, rtol=0.1)


@pytest.mark.parametrize(("degrees", "lamps"), [(1.0, 1), (3.0, 1), (5.0, 1), (12.0, 6)])
def test_tables_split_a_map_into_lamps_and_the_rest(degrees, lamps):
    tables = precompute_environment(lamp(0.7, np.radians(degrees), 200.0, 0.2), None)
    assert len(tables.lamps) == lamps
    assert tables.lampless.max() < (10.0 if lamps == 1 else 201.0)
    # No light is lost or counts twice.
    directions, solid_angles = map_directions(len(tables.lampless))
    for normal in (toward(1.0), toward(0.5, 1.0), toward(0.7, -0.4)):
        cosine = np.maximum(directions @ normal, 0.0) * solid_angles
        whole, rest = ((image * cosine[..., None]).sum(axis=(0, 1)) for image in (tables.radiance, tables.lampless))
        light = sum(each.irradiance * max(float(normal @ each.direction), 0.0) for each in tables.lamps)
        np.testing.assert_allclose(rest + light, whole, rtol=5e-3)


def test_cluttered_scene_approaches_the_reference(device):
    view = camera(96, 72, 420.0, (0.0, 0.0, 1.5))
    lights = (EnvironmentMap("room", 0.4 * even_light(1.0, 64).radiance + lamp(0.8, np.radians(14.0), 8.0, rows=64).radiance),)
    reference = render_objects(device, *clutter(), lights=lights, view=view, config=with_render(REFERENCE, samples=256)).radiance[0]
    quality = {}
    for paths in (1, 4, 16):
        denoised = render_objects(device, *clutter(), lights=lights, view=view, config=with_render(coarse_paths=paths)).radiance[0]
        quality[paths] = psnr(denoised, reference)
        if paths > 1:
            np.testing.assert_allclose(denoised.mean(axis=(0, 1)), reference.mean(axis=(0, 1)), rtol=0.015)
    # Without denoiser one path has 20 dB and four have 28; with blocks of 4 x 4 coarse pixels alone 29 and 36.
    assert quality[1] < quality[4] < quality[16]
    assert quality[1] > 33.0
    assert quality[4] > 37.0


def test_two_frames_of_a_still_scene_are_identical(device):
    """Scratch of another scene's frame in between leaves no trace."""
    toy = ToyScene([entry(mesh, material) for mesh, material, *_ in clutter()], [[], []], (VIEW,), lights=(sun((0.5, 0.2, 0.8), rows=256),))
    toy.placed[0] = [(index, pose[0] if pose else FLAT) for index, (_, _, *pose) in enumerate(clutter())][1:]
    toy.placed[1] = [(0, (0.0, 0.0, 0.2, *UPRIGHT))]
    toy.config = with_render(coarse_pixel=4)
    scene = build_scene(toy, device)
    renderer = make_renderer(toy.settings(), scene, toy.instances, 1)
    out = allocate_view_buffers(1, scene.width, scene.height, toy.instances, device)
    state, zero, images = snapshot(toy, device), wp.zeros(1, dtype=wp.int32, device=device), []
    for world in (0, 1, 0, 0):
        views = make_views(wp.array([world], dtype=wp.int32, device=device), zero, 1, toy.instances)
        renderer.render(state, views, out)
        images.append(renderer.image.radiance.numpy().copy())
    assert images[0].tobytes() != images[1].tobytes()
    assert images[0].tobytes() == images[2].tobytes() == images[3].tobytes()


@pytest.mark.parametrize("cell", [0, 1, 2, 4, 7])
@pytest.mark.parametrize("size", [(64, 48), (61, 35), (3, 5), (1, 1)])
def test_coarse_pixels_and_images_of_any_size_render(device, cell, size):
    view = camera(*size, 4.0 * size[0], (0.0, 0.0, 2.0))
    picture = render_objects(
        device, *clutter(), lights=(sun((0.5, 0.2, 0.8)),), view=view, table=True, config=with_render(coarse_pixel=cell)
    )
    assert picture.radiance.shape[1:3] == size[::-1]
    assert np.isfinite(picture.radiance).all()
    assert (picture.radiance > 0.0).all()


@pytest.mark.parametrize("cell", [1, 2, 4])
def test_wider_coarse_pixels_have_the_same_light(device, cell):
    view = camera(160, 120, 700.0, (0.0, 0.0, 1.5))
    fine, wide = (
        render_objects(device, *clutter(), view=view, config=with_render(coarse_pixel=size, coarse_paths=8)).radiance[0]
        for size in (1, cell)
    )
    np.testing.assert_allclose(wide.mean(axis=(0, 1)), fine.mean(axis=(0, 1)), rtol=0.015)
    assert psnr(wide, fine + 1e-6) > 28.0


@pytest.mark.parametrize("light", [EVEN, sun((0.3, 0.2, 0.8))])
def test_objects_smaller_than_a_coarse_pixel_are_lit(device, light):
    # 3 px in coarse pixels of 16 px, over background: the middle of none of them lies on it.
    small_sheet = (sheet(0.03, 0.03), surface(HALF), (0.055, 0.035, 0.0, *UPRIGHT))
    coarse, fine = (
        render_objects(device, small_sheet, lights=(light,), config=with_render(coarse_pixel=size, coarse_paths=16)) for size in (16, 1)
    )
    visible = coarse.instance[0] == 1
    assert 4 <= visible.sum() <= 16
    np.testing.assert_allclose(coarse.radiance[0][visible].mean(), fine.radiance[0][visible].mean(), rtol=0.05)


def test_only_background_and_only_table(device):
    light = sun((0.3, 0.2, 0.8))
    nothing, table = (render_objects(device, lights=(light,), table=table).radiance[0] for table in (False, True))
    np.testing.assert_allclose(nothing[0, 0], 0.3, rtol=1e-5)
    assert (render_objects(device, lights=(light,)).instance == 0).all()
    # The table is an open plane: uniform.
    assert (table.std(axis=(0, 1)) < 0.02 * table.mean(axis=(0, 1))).all()
    reference = render_objects(device, lights=(light,), table=True, config=with_render(REFERENCE, samples=256)).radiance[0]
    np.testing.assert_allclose(table.mean(axis=(0, 1)), reference.mean(axis=(0, 1)), rtol=0.02)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 2.0])
def test_sun_shadow_has_its_geometric_outline(device, yaw):
    # A sheet 0.2 m across floats 0.1 m above another; the sun stands at 45°: its shadow is as large, 0.1 m away from the sun.
    view = camera(160, 160, 400.0, (0.0, 0.0, 2.0))
    objects = [(sheet(2.0, 2.0), surface(HALF)), (sheet(0.06, 0.06), surface(HALF), (0.0, 0.0, 0.1, *UPRIGHT))]
    light = sun((1.0, 0.0, 1.0), rows=256, strength=6000.0)
    tables = precompute_environment(light, None)
    (only,) = tables.lamps
    direction = only.direction
    lit = render_objects(device, *objects, lights=(light,), view=view, light_yaw=yaw, config=with_render(coarse_paths=16))
    ground = lit.instance[0] == 1
    rows, columns = np.mgrid[:160, :160]
    x, y = (columns + 0.5 - 80.0) / 200.0, -(rows + 0.5 - 80.0) / 200.0
    offset = (
        -0.1
        / direction[2]
        * np.array([np.cos(yaw) * direction[0] - np.sin(yaw) * direction[1], np.sin(yaw) * direction[0] + np.cos(yaw) * direction[1]])
    )
    # Signed distance inside the shadow's square [m]; the filter blurs the edge by 2 px to either side, the sun by less.
    inside = 0.03 - np.maximum(np.abs(x - offset[0]), np.abs(y - offset[1]))
    value = lit.radiance[0, ..., 0]
    blur = 3.5 / 200.0
    dark, bright = value[ground & (inside > blur)], value[ground & (inside < -blur) & (np.hypot(x, y) > 0.12)]
    assert len(dark) > 20
    middle = 0.5 * (dark.mean() + bright.mean())
    assert dark.max() < middle < bright.min()
    # The outline itself: as many pixels are darker than the mean of both as the square has.
    np.testing.assert_allclose((value[ground] < middle).sum(), (ground & (inside > 0.0)).sum(), rtol=0.12)


@pytest.mark.parametrize("turn", [0.0, 0.15])
def test_shadow_at_the_edge_of_a_sunlit_surface_stays_dark(device, turn):
    """A sunlit sheet floats 16 px above its shadow. Shadowed pixels beside it: some have no shadow ray on their surface near."""
    view = camera(160, 160, 400.0, (0.0, 0.0, 2.0))
    pose = (0.0, 0.0, 0.08, 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))
    objects = [(sheet(2.0, 2.0), surface(HALF)), (sheet(0.4, 0.4), surface(WHITE), pose)]
    light = sun((1.0, 0.0, 1.0), rows=256, strength=6000.0)
    config = with_render(coarse_pixel=4, coarse_paths=4, antialias=False)
    picture = render_objects(device, *objects, lights=(light,), view=view, config=config)
    ground, value = picture.instance[0] == 1, picture.radiance[0, ..., 0]
    strip = np.zeros_like(ground)
    for shift in (1, 2):
        strip[60:100, :-shift] |= ground[60:100, :-shift] & ~ground[60:100, shift:]
    strip[:, 80:] = False
    assert strip.sum() >= 40 * 2
    assert value[strip].max() < 1.4 * np.median(value[strip])


def test_scratch_has_the_size_of_the_scenes_images(device):
    config = replace(with_render(coarse_pixel=4), cameras=replace(Config().cameras, resolution=(8, 8)))
    scene = build_render_scene(
        config.render, -config.tote.wall, Catalog((entry(sheet(0.1, 0.1)),)), ToyScene([], [], ()).fixtures, (VIEW,), (EVEN,), device
    )
    shading = make_renderer(config, scene, 1, 2).shading
    assert shading.guide.surface.shape == shading.ratios.record.shape == (2, 12, 16)
    assert shading.shadow_rays.packed.shape == shading.shadows.record.shape == (2, 12, 16)
    assert shading.shadows.edge.shape == (2, 48, 64)


def test_light_does_not_leak_from_the_rim_of_a_pit_to_its_floor(device):
    """Pixels of a pit's floor next to its rim: none of their four coarse pixels lies on the floor."""
    rim = [
        (sheet(*size), surface(HALF), (sign * x, sign * y, 0.4, *UPRIGHT))
        for size, x, y in (((0.4, 0.8), 0.27, 0.0), ((0.14, 0.4), 0.0, 0.27))
        for sign in (-1.0, 1.0)
    ]
    objects = [(sheet(0.5, 0.5), surface(HALF), (0.0, 0.0, 0.0, *UPRIGHT)), *rim]
    view = camera(64, 48, 300.0, (0.0, 0.0, 2.0))
    denoised, reference = (
        render_objects(device, *objects, view=view, instances=5, config=with_render(mode, coarse_pixel=5, coarse_paths=16, samples=256))
        for mode in (FAST, REFERENCE)
    )
    floor = denoised.instance[0] == 1
    bright = [np.quantile(picture.radiance[0][floor].mean(axis=-1), 0.98) for picture in (denoised, reference)]
    assert bright[0] < 1.1 * bright[1]


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_indirect_sunlight_equals_the_reference(device, metallic):
    """A valley under a low sun and a nearly black sky: one slope has only light that the sunlit one reflects, diffuse or specular."""
    half = np.pi / 8
    slopes = [
        (sheet(0.2, 0.3), surface((0.9, 0.9, 0.9), metal), (side * 0.0707, 0.0, 0.0707, 0.0, side * -np.sin(half), 0.0, np.cos(half)))
        for side, metal in ((-1, metallic), (1, 0.0))
    ]
    low_sun = (sun((-0.9, 0.0, 0.3), sky=0.002),)
    configs = (with_render(coarse_paths=16, coarse_pixel=1), with_render(REFERENCE, samples=256))
    denoised, reference = (render_objects(device, *slopes, lights=low_sun, config=config) for config in configs)
    for instance in (1, 2):
        inside = cv2.erode((denoised.instance[0] == instance).astype(np.uint8), np.ones((3, 3))) > 0
        means = [picture.radiance[0][inside].mean() for picture in (denoised, reference)]
        assert means[0] == pytest.approx(means[1], rel=0.05)


@pytest.mark.parametrize("roughness", [0.2, 0.5])
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_specular_highlight_of_a_small_lamp_equals_the_reference(device, metallic, roughness):
    """Beside the highlight, and in it."""
    plate = (sheet(0.3, 0.2), surface((0.8, 0.8, 0.8), metallic, roughness))
    for cosine in (0.9, 0.99):
        light = (lamp(cosine, np.radians(2.0), 500.0, 0.01),)
        configs = (with_render(coarse_paths=16, coarse_pixel=1), with_render(REFERENCE, samples=256))
        denoised, reference = (render_objects(device, plate, lights=light, config=config) for config in configs)
        inside = cv2.erode((denoised.instance[0] == 1).astype(np.uint8), np.ones((5, 5))) > 0
        assert denoised.radiance[0][inside].mean() == pytest.approx(reference.radiance[0][inside].mean(), rel=0.02)
