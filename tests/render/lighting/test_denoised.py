"""Modes of the renderer: known amounts of light, the same annotations, the path-traced reference, and the error of the denoised light."""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.lighting.paths.tracing import BRDF_SAMPLING, LIGHT_SAMPLING
from synpick_warp.scenes.types import Catalog, EnvironmentMap
from synpick_warp.stages.buffers import allocate_view_buffers
from synpick_warp.stages.render import denoised
from synpick_warp.stages.render.denoised import history_sizes, scratch_sizes
from synpick_warp.stages.render.light_tables import measure_albedo, precompute_environment
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tests.harness.brdf_probe import evaluate, toward
from tests.worlds.shapes import FLAT, HALF, UPRIGHT, WHITE, ball, box, camera, entry, even_light, lamp, sheet, sun, surface
from tests.worlds.toy_scene import (
    ANNOTATIONS,
    RenderedViews,
    ToyScene,
    assert_same,
    build_scene,
    clutter,
    psnr,
    render_objects,
    snapshot,
    with_render,
)

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
MODES = (FAST, REFERENCE, UNOCCLUDED)
PAIR = [(ball(0.1, 3), surface(WHITE, 1.0, 0.0)), (box(0.1, 0.1, 0.1), surface(), (0.1, 0.0, 0.05, *UPRIGHT))]
"""A mirroring ball and a white box."""


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.25), (0.0, 1.0), (1.0, 0.0), (1.0, 0.6)])
def test_white_furnace(device, mode, metallic, roughness):
    view = camera(128, 96, 500.0, (0.0, 0.0, 2.0))
    white = (ball(0.1, 4), surface(WHITE, metallic, roughness))
    picture = render_objects(device, white, lights=(even_light(2.0),), view=view, config=with_render(mode, samples=8))
    np.testing.assert_allclose(picture.radiance[0, 0, 0], 2.0, rtol=1e-5)
    np.testing.assert_allclose(picture.radiance[0][picture.instance[0] == 1].mean(axis=0), 2.0, rtol=0.01)


@pytest.mark.parametrize(
    ("mode", "degrees", "size", "cosine"),
    [
        *((*row, cosine) for row in ((REFERENCE, 6.0, 16), (FAST, 3.5, 64)) for cosine in (1.0, 0.6, 0.25)),
        *((FAST, degrees, 64, 0.6) for degrees in (2.0, 6.0, 12.0)),
    ],
)
def test_plane_under_a_lamp_has_the_analytic_irradiance(device, cosine, mode, degrees, size):
    """A disc of angular radius a and radiance L that is entirely above the horizon: E = π L sin² a cos θ.

    In mode fast, wide discs are several lamps, and the light of most of 12° stays in the map.
    """
    radius = np.radians(degrees)
    light, view = lamp(cosine, radius, 3.0 / (np.pi * np.sin(radius) ** 2)), camera(size, size, 2000.0, (0.0, 0.0, 2.0))
    config = with_render(mode, coarse_paths=32, samples=64)
    picture = render_objects(device, (sheet(1.0, 1.0), surface(HALF)), lights=(light,), view=view, config=config)
    value, _ = evaluate(measure_albedo(device), ((0.5,) * 3, 0.0, 1.0), toward(1.0), toward(cosine))
    np.testing.assert_allclose(picture.radiance[0].mean(axis=(0, 1)), value[0] * 3.0, rtol=0.01 if mode == REFERENCE else 0.02)
    # The BRDF is nearly Lambertian here: the specular lobe adds about what it takes from the diffuse one.
    np.testing.assert_allclose(value[0] / cosine, 0.5 / np.pi, rtol=0.1)


def test_annotations_are_those_of_all_modes(device):
    view = camera(160, 120, 300.0, (0.0, 0.0, 1.0))
    fast, reference, unoccluded = (render_objects(device, *clutter(), view=view, config=with_render(mode, samples=1)) for mode in MODES)
    for other in (reference, unoccluded):
        assert_same(fast, other, *ANNOTATIONS)
        assert (fast.color != other.color).any()
    assert psnr(unoccluded.radiance, fast.radiance) > 20.0


@pytest.mark.parametrize("mode", MODES)
def test_rendering_is_reproducible_and_finite(device, mode):
    """The noise of paths depends on the seed."""
    configs = [replace(with_render(mode, samples=4), bake=replace(Config().bake, seed=seed)) for seed in (1, 1, 2)]
    first, second, other = (
        render_objects(device, *PAIR, lights=(sun((0.3, 0.2, 0.8)),), view=VIEW, table=True, config=config, fixtures_visible=(1, 1, 1))
        for config in configs
    )
    assert_same(first, second, "color", "radiance")
    assert np.isfinite(first.radiance).all()
    assert (first.radiance >= 0.0).all()
    assert (first.radiance != other.radiance).any() == (mode != UNOCCLUDED)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("radiance", [0.0, 1e-6])
def test_black_maps_render_finite_values_and_in_the_reference_black(device, mode, radiance):
    picture = render_objects(device, *PAIR, lights=(even_light(radiance),), view=VIEW, table=True, config=with_render(mode, samples=4))
    assert np.isfinite(picture.radiance).all()
    assert mode != REFERENCE or picture.radiance.any() == (radiance > 0.0)


# ---- unoccluded ----


def test_walls_darken_a_floor_but_in_mode_unoccluded(device):
    """The floor between two high walls has the radiance of an open one; in mode fast it is darker."""
    floor = (sheet(0.6, 0.5), surface(HALF))
    walls = [(box(0.02, 0.4, 0.3), surface((0.1,) * 3), (x, 0.0, 0.15, *UPRIGHT)) for x in (-0.1, 0.1)]
    view = camera(64, 48, 600.0, (0.0, 0.0, 2.0))
    pictures = [
        render_objects(device, floor, *occluders, view=view, config=with_render(mode, coarse_paths=16))
        for mode, occluders in ((UNOCCLUDED, walls), (UNOCCLUDED, ()), (FAST, walls))
    ]
    unoccluded, alone, fast = (picture.radiance[0][picture.instance[0] == 1].mean() for picture in pictures)
    np.testing.assert_allclose(unoccluded, alone, rtol=1e-5)
    assert fast < 0.8 * unoccluded


def test_sunlight_and_shadows_are_those_of_the_reference(device):
    """Under a lamp without sky, and one bounce: a box on a plane and its shadow."""
    light = lamp(0.7, np.radians(1.5), 300.0)
    objects = [(sheet(0.6, 0.5), surface(HALF)), (box(0.1, 0.1, 0.1), surface(HALF), (0.0, 0.0, 0.05, *UPRIGHT))]
    pictures = [
        render_objects(device, *objects, lights=(light,), view=VIEW, config=config)
        for config in (with_render(UNOCCLUDED), with_render(REFERENCE, samples=64, bounces=1))
    ]
    unoccluded, reference = (picture.radiance[0] for picture in pictures)
    on_surface = pictures[0].instance[0] > 0
    lit, visible = np.median(reference[on_surface]), cv2.erode(on_surface.astype(np.uint8), np.ones((3, 3))) > 0
    shadow = cv2.erode((visible & (reference.mean(axis=2) < 0.2 * lit)).astype(np.uint8), np.ones((3, 3))) > 0
    assert shadow.sum() > 20
    assert unoccluded[shadow].max() < 0.3 * lit  # Unoccluded light is at least 5 % of the mean of the map.
    assert psnr(unoccluded, reference) > 43.0


def test_no_memory_for_paths_and_histories():
    unoccluded, fast = (with_render(mode).render for mode in (UNOCCLUDED, FAST))
    of_unoccluded, of_fast = (scratch_sizes(render, 1920, 1080, 12) for render in (unoccluded, fast))
    shadow_grid = {"shadow_row", "shadow_column", "edge_chunk", "chunk_pixel"}  # As wide as coarse pixels are in images of their own.
    differing = {key for key, size in of_unoccluded.items() if size != of_fast[key]}
    assert differing - shadow_grid == {"cell_row", "cell_column", "region"}
    assert all(of_unoccluded[key] <= of_fast[key] for key in differing - {"chunk_pixel"})  # Fewer chunks, of more pixels.
    assert of_unoccluded["cell_row"] == of_unoccluded["cell_column"] == of_unoccluded["region"] == 0
    kept = [history_sizes(render, 1920, 1080, 12) for render in (unoccluded, fast, replace(fast, history=0))]
    assert [(sizes["world_camera"], sizes["cell_row"] > 0) for sizes in kept] == [(12, False), (12, True), (0, True)]


# ---- path-traced reference ----


def trace_objects(device, *placed, samples=32, bounces=4, view=VIEW, **more):
    return render_objects(device, *placed, view=view, config=with_render(REFERENCE, samples=samples, bounces=bounces), **more)


def test_white_furnace_with_interreflection(device):
    # Russian roulette is unbiased, and 32 bounces lose no light; one bounce does.
    objects = [
        (sheet(0.6, 0.4), surface()),
        (box(0.1, 0.1, 0.1), surface(), (0.08, 0.0, 0.055, *UPRIGHT)),
        (box(0.1, 0.1, 0.1), surface(WHITE, 1.0, 0.5), (-0.08, 0.0, 0.055, *UPRIGHT)),
    ]
    many, one = (trace_objects(device, *objects, bounces=bounces).radiance for bounces in (32, 1))
    assert many.mean() == pytest.approx(1.0, abs=0.01)
    assert one.mean() < 0.98


def test_russian_roulette_is_unbiased(device, monkeypatch):
    grey = surface(HALF)
    walls = [(box(0.02, 0.3, 0.2), grey, (x, 0.0, 0.1, *UPRIGHT)) for x in (0.03, -0.03)]
    view = camera(8, 24, 200.0, (0.0, 0.0, 2.0))
    means = []
    for roulette in (0, 2, 100):
        monkeypatch.setattr(denoised, "REFERENCE_ROULETTE", roulette)
        radiance = trace_objects(device, (sheet(0.3, 0.3), grey), *walls, samples=1024, bounces=16, view=view).radiance
        # Between the walls, where light arrives after several bounces.
        means.append(radiance[0, 4:20, 3:5].mean())
    np.testing.assert_allclose(means, means[-1], rtol=0.02)
    assert means[-1] < 0.3


def test_sampling_strategies_have_the_same_mean(device, monkeypatch):
    objects = [
        (sheet(0.6, 0.4), surface((0.7, 0.6, 0.5), 0.0, 0.5)),
        (ball(0.06, 3), surface((0.9, 0.8, 0.7), 1.0, 0.35), (0.05, 0.0, 0.06, *UPRIGHT)),
        (box(0.1, 0.1, 0.1), surface((0.3, 0.5, 0.7)), (-0.1, 0.0, 0.05, *UPRIGHT)),
    ]
    radiance = 0.3 * even_light(1.0, 64).radiance + lamp(0.7, np.radians(12.0), 20.0, rows=64).radiance
    lights = (EnvironmentMap("room", radiance),)
    combined = trace_objects(device, *objects, lights=lights, samples=64, light_yaw=0.7).radiance[0]
    noise = {}
    for strategy in (LIGHT_SAMPLING, BRDF_SAMPLING):
        monkeypatch.setattr(denoised, "COMBINED", strategy)
        alone = trace_objects(device, *objects, lights=lights, samples=128, light_yaw=0.7).radiance[0]
        np.testing.assert_allclose(alone.mean(axis=(0, 1)), combined.mean(axis=(0, 1)), rtol=0.01)
        noise[strategy] = np.abs(alone - combined).mean()
    assert noise[LIGHT_SAMPLING] < noise[BRDF_SAMPLING]


def test_a_mirror_reflects_a_box_above_it(device):
    # A black box 0.5 m above the mirror and 0.2 m to the side: its image appears at 0.2 · 2 / 2.5 m, 16 px from the middle.
    objects = [(sheet(1.0, 1.0), surface(WHITE, 1.0, 0.0)), (box(0.06, 0.06, 0.06), surface((0.0, 0.0, 0.0)), (0.2, 0.0, 0.5, *UPRIGHT))]
    row = trace_objects(device, *objects).radiance[0, 24, :, 0]
    assert row[48] < 0.15
    np.testing.assert_allclose(row[16], 1.0, rtol=0.03)


def test_no_light_leaks_through_a_surface(device):
    # The lamp stands below the sheet's plane, but above that of its tilted interpolated normals.
    tilted = sheet(0.6, 0.4)
    tilted.normals[:] = toward(0.7)
    lights = (lamp(-0.3, np.radians(8.0), 100.0),)
    assert trace_objects(device, (tilted, surface()), lights=lights).radiance[0, 10:38, 10:54].max() == 0.0
    assert trace_objects(device, (sheet(0.6, 0.4), surface()), lights=(lamp(0.3, np.radians(8.0), 100.0),)).radiance[0, 24, 32].min() > 0.1


# ---- denoised light ----


EVEN = even_light()
denoise_objects = functools.partial(render_objects, view=VIEW)


def with_reference(device, *objects, settings: dict[str, int], **more) -> list[RenderedViews]:
    """Objects by the denoised renderer and by the reference."""
    return [denoise_objects(device, *objects, config=with_render(mode, samples=256, **settings), **more) for mode in (FAST, REFERENCE)]


@pytest.mark.parametrize("table", [False, True])
def test_grey_plane_under_a_uniform_map_equals_the_reference(device, table):
    plane = (sheet(0.6, 0.5), surface(HALF, 0.0, 0.7))
    pictures = with_reference(device, plane, table=table, settings={"coarse_paths": 16})
    denoised, reference = (picture.radiance.mean(axis=(0, 1, 2)) for picture in pictures)
    np.testing.assert_allclose(denoised, reference, rtol=0.01)
    np.testing.assert_allclose(denoised, 0.5, rtol=0.1)


def test_cluttered_scene_approaches_the_reference(device):
    view = camera(96, 72, 420.0, (0.0, 0.0, 1.5))
    lights = (EnvironmentMap("room", 0.4 * even_light(1.0, 64).radiance + lamp(0.8, np.radians(14.0), 8.0, rows=64).radiance),)
    reference = denoise_objects(device, *clutter(), lights=lights, view=view, config=with_render(REFERENCE, samples=256)).radiance[0]
    quality = {}
    for paths in (1, 4, 16):
        denoised = denoise_objects(device, *clutter(), lights=lights, view=view, config=with_render(coarse_paths=paths)).radiance[0]
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
    picture = denoise_objects(
        device, *clutter(), lights=(sun((0.5, 0.2, 0.8)),), view=view, table=True, config=with_render(coarse_pixel=cell)
    )
    assert picture.radiance.shape[1:3] == size[::-1]
    assert np.isfinite(picture.radiance).all()
    assert (picture.radiance > 0.0).all()


@pytest.mark.parametrize("cell", [1, 2, 4])
def test_wider_coarse_pixels_have_the_same_light(device, cell):
    view = camera(160, 120, 700.0, (0.0, 0.0, 1.5))
    fine, wide = (
        denoise_objects(device, *clutter(), view=view, config=with_render(coarse_pixel=size, coarse_paths=8)).radiance[0]
        for size in (1, cell)
    )
    np.testing.assert_allclose(wide.mean(axis=(0, 1)), fine.mean(axis=(0, 1)), rtol=0.015)
    assert psnr(wide, fine + 1e-6) > 28.0


@pytest.mark.parametrize("light", [EVEN, sun((0.3, 0.2, 0.8))])
def test_objects_smaller_than_a_coarse_pixel_are_lit(device, light):
    # 3 px in coarse pixels of 16 px, over background: the middle of none of them lies on it.
    small_sheet = (sheet(0.03, 0.03), surface(HALF), (0.055, 0.035, 0.0, *UPRIGHT))
    coarse, fine = (
        denoise_objects(device, small_sheet, lights=(light,), config=with_render(coarse_pixel=size, coarse_paths=16)) for size in (16, 1)
    )
    visible = coarse.instance[0] == 1
    assert 4 <= visible.sum() <= 16
    np.testing.assert_allclose(coarse.radiance[0][visible].mean(), fine.radiance[0][visible].mean(), rtol=0.05)


def test_only_background_and_only_table(device):
    light = sun((0.3, 0.2, 0.8))
    nothing, table = (denoise_objects(device, lights=(light,), table=table).radiance[0] for table in (False, True))
    np.testing.assert_allclose(nothing[0, 0], 0.3, rtol=1e-5)
    assert (denoise_objects(device, lights=(light,)).instance == 0).all()
    # The table is an open plane: uniform.
    assert (table.std(axis=(0, 1)) < 0.02 * table.mean(axis=(0, 1))).all()
    reference = denoise_objects(device, lights=(light,), table=True, config=with_render(REFERENCE, samples=256)).radiance[0]
    np.testing.assert_allclose(table.mean(axis=(0, 1)), reference.mean(axis=(0, 1)), rtol=0.02)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 2.0])
def test_sun_shadow_has_its_geometric_outline(device, yaw):
    # A sheet 0.2 m across floats 0.1 m above another; the sun stands at 45°: its shadow is as large, 0.1 m away from the sun.
    view = camera(160, 160, 400.0, (0.0, 0.0, 2.0))
    objects = [(sheet(2.0, 2.0), surface(HALF)), (sheet(0.06, 0.06), surface(HALF), (0.0, 0.0, 0.1, *UPRIGHT))]
    light = sun((1.0, 0.0, 1.0), rows=256, strength=6000.0)
    (only,) = precompute_environment(light, None).lamps
    direction = only.direction
    lit = denoise_objects(device, *objects, lights=(light,), view=view, light_yaw=yaw, config=with_render(coarse_paths=16))
    ground = lit.instance[0] == 1
    rows, columns = np.mgrid[:160, :160]
    x, y = (columns + 0.5 - 80.0) / 200.0, -(rows + 0.5 - 80.0) / 200.0
    turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ direction[:2]
    offset = -0.1 / direction[2] * turned
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


def test_a_map_turned_by_its_yaw_lights_sides_as_one_that_is_painted_so(device):
    objects = [(box(0.2, 0.16, 0.12), surface(HALF), (0.0, 0.0, 0.0, *np.array([0.3, 0.2, 0.1, 0.9]) / np.sqrt(0.95)))]
    lights = [sun(direction, rows=256, strength=6000.0) for direction in ((1.0, 0.5, 0.5), (-0.5, 1.0, 0.5))]
    turned, painted = (
        denoise_objects(device, *objects, lights=(light,), light_yaw=yaw) for light, yaw in zip(lights, (np.pi / 2, 0.0), strict=True)
    )
    shown = painted.instance[0] == 1
    assert np.abs(turned.radiance - painted.radiance)[0, shown].mean() < 0.02 * painted.radiance[0, shown].mean()


@pytest.mark.parametrize("turn", [0.0, 0.15])
def test_shadow_at_the_edge_of_a_sunlit_surface_stays_dark(device, turn):
    """A sunlit sheet floats 16 px above its shadow. Shadowed pixels beside it: some have no shadow ray on their surface near."""
    view = camera(160, 160, 400.0, (0.0, 0.0, 2.0))
    pose = (0.0, 0.0, 0.08, 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))
    objects = [(sheet(2.0, 2.0), surface(HALF)), (sheet(0.4, 0.4), surface(WHITE), pose)]
    light = sun((1.0, 0.0, 1.0), rows=256, strength=6000.0)
    config = with_render(coarse_pixel=4, coarse_paths=4, antialias=False)
    picture = denoise_objects(device, *objects, lights=(light,), view=view, config=config)
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
    denoised, reference = with_reference(device, *objects, view=view, instances=5, settings={"coarse_pixel": 5, "coarse_paths": 16})
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
    denoised, reference = with_reference(device, *slopes, lights=low_sun, settings={"coarse_pixel": 1, "coarse_paths": 16})
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
        denoised, reference = with_reference(device, plate, lights=light, settings={"coarse_pixel": 1, "coarse_paths": 16})
        inside = cv2.erode((denoised.instance[0] == 1).astype(np.uint8), np.ones((5, 5))) > 0
        assert denoised.radiance[0][inside].mean() == pytest.approx(reference.radiance[0][inside].mean(), rel=0.02)
