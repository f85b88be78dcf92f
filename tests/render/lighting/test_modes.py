"""What the renderer's modes have in common: known amounts of light, the same annotations; and what the mode unoccluded leaves out."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED, Config
from synpick_warp.stages.render.denoised import history_sizes, scratch_sizes
from synpick_warp.stages.render.light_tables import measure_albedo
from tests.harness.brdf_probe import evaluate, toward
from tests.worlds.toy_scene import (
    ANNOTATIONS,
    HALF,
    UPRIGHT,
    WHITE,
    assert_same,
    ball,
    box,
    camera,
    clutter,
    even_light,
    lamp,
    psnr,
    render_objects,
    sheet,
    sun,
    surface,
    with_render,
)

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
MODES = (FAST, REFERENCE, UNOCCLUDED)
PAIR = [(ball(0.1, 3), surface(WHITE, 1.0, 0.0)), (box(0.1, 0.1, 0.1), surface(), (0.1, 0.0, 0.05, *UPRIGHT))]
"""A mirroring ball and a white box."""


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.25, 0.6, 1.0])
def test_white_furnace(device, mode, metallic, roughness):
    view = camera(128, 96, 500.0, (0.0, 0.0, 2.0))
    white = (ball(0.1, 4), surface(WHITE, metallic, roughness))
    picture = render_objects(device, white, lights=(even_light(2.0),), view=view, config=with_render(mode, samples=8))
    np.testing.assert_allclose(picture.radiance[0, 0, 0], 2.0, rtol=1e-5)
    np.testing.assert_allclose(picture.radiance[0][picture.instance[0] == 1].mean(axis=0), 2.0, rtol=0.01)


@pytest.mark.parametrize("cosine", [1.0, 0.6, 0.25])
@pytest.mark.parametrize(("mode", "degrees", "size"), [(REFERENCE, 6.0, 16), *((FAST, degrees, 64) for degrees in (2.0, 3.5, 6.0, 12.0))])
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
    assert history_sizes(unoccluded, 1920, 1080, 12)["world_camera"] == 0
    assert history_sizes(fast, 1920, 1080, 12)["world_camera"] == 12
