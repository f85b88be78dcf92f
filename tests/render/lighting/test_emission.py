"""Emission: what surfaces emit is added to what they reflect, in units of a picture's white, and lights others."""

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED
from synpick_warp.scenes.types import MAP_CENTER
from tests.render.lighting.test_transparency import CHECKS, COAT, INSIDE, PANE, RAISED, VIEW, pane, picture
from tests.worlds.shapes import FLAT, UPRIGHT, even_light, sheet, surface
from tests.worlds.toy_scene import render_objects, with_render

LIGHT = np.array([0.25, 0.5, 1.0])
GREY = surface((0.5, 0.5, 0.5))
SHINING = replace(GREY, emission=tuple(LIGHT.tolist()))
MODES = pytest.mark.parametrize("mode", [UNOCCLUDED, FAST, REFERENCE])


def emitted(device, mode, lit=SHINING, dark=GREY, **more):
    """What emission adds to the radiance of a sheet."""
    shown = [render_objects(device, (PANE, each, FLAT), view=VIEW, config=with_render(mode, samples=16), **more) for each in (lit, dark)]
    return shown[0].radiance[INSIDE] - shown[1].radiance[INSIDE]


@MODES
def test_emission_is_added_to_what_a_surface_reflects(device, mode):
    added = emitted(device, mode)
    np.testing.assert_allclose(added, added[0, 0, 2] * np.broadcast_to(LIGHT, added.shape), rtol=1e-4)


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_an_emission_looks_the_same_under_any_map(device, factor):
    dim, bright = (emitted(device, UNOCCLUDED, lights=(even_light(each),)) for each in (1.0, factor))
    np.testing.assert_allclose(bright, factor * dim, rtol=1e-3)


def test_an_emission_texture_is_a_factor(device):
    flat = np.broadcast_to(np.array([MAP_CENTER, MAP_CENTER, 255, 0], np.uint8), (*CHECKS.shape[:2], 4))
    dark = replace(surface((0.5, 0.5, 0.5), texture=np.full(CHECKS.shape, 255, np.uint8)), maps=flat)
    patterned = emitted(device, UNOCCLUDED, replace(dark, emission=SHINING.emission, glow=CHECKS), dark)
    whole = emitted(device, UNOCCLUDED)
    share = patterned / whole
    assert share.min() == pytest.approx(0.0, abs=0.01)
    assert share.max() == pytest.approx(1.0, abs=0.01)
    assert share.mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("mode", "tolerance"), [(FAST, 0.05), (REFERENCE, 0.03)])
def test_an_emitter_lights_a_floor_by_its_view_factor(device, mode, tolerance):
    """A square of side 2 a, at the height a above a matt white floor, which reflects its view factor of the emission."""
    height = 1.5
    above = (0.0, 0.0, height, *UPRIGHT)
    lamps = [replace(surface((0.0, 0.0, 0.0)), emission=emission) for emission in ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))]
    config = with_render(mode, samples=256, bounces=2)
    ceiling = sheet(2.0 * height, 2.0 * height)
    shown = [render_objects(device, (PANE, surface(), FLAT), (ceiling, lamp, above), view=VIEW, config=config) for lamp in lamps]
    found = (shown[0].radiance[INSIDE] - shown[1].radiance[INSIDE]).mean()
    corner = 2.0 / (2.0 * np.pi) / np.sqrt(2.0) * np.arctan(1.0 / np.sqrt(2.0))
    alone = emitted(device, UNOCCLUDED).mean() / LIGHT.mean()
    assert found / alone == pytest.approx(4.0 * corner, rel=tolerance)


@MODES
def test_glass_shows_an_emitter_behind_it(device, mode):
    plain, behind = (
        picture(device, cover, mode, floor=SHINING).radiance[INSIDE] - picture(device, cover, mode, floor=GREY).radiance[INSIDE]
        for cover in (None, pane(1.0))
    )
    np.testing.assert_allclose(behind, (1.0 - COAT) * plain, rtol=0.03)
    assert RAISED[2] > 0.0
