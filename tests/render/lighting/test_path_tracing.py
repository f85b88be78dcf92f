"""Path-traced reference: known amounts of light, and the same mean from each sampling strategy."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.configs.schema import REFERENCE
from synpick_warp.kernels.render.lighting.paths.tracing import BRDF_SAMPLING, LIGHT_SAMPLING
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.render import reference
from tests.harness.brdf_probe import toward
from tests.worlds import toy_scene
from tests.worlds.toy_scene import HALF, UPRIGHT, WHITE, ball, box, camera, even_light, lamp, sheet, surface, with_render

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))


def render_objects(device, *placed, samples=32, bounces=4, view=VIEW, **more):
    return toy_scene.render_objects(device, *placed, view=view, config=with_render(REFERENCE, samples=samples, bounces=bounces), **more)


def test_white_furnace_with_interreflection(device):
    # Russian roulette is unbiased, and 32 bounces lose no light; one bounce does.
    objects = [
        (sheet(0.6, 0.4), surface()),
        (box(0.1, 0.1, 0.1), surface(), (0.08, 0.0, 0.055, *UPRIGHT)),
        (box(0.1, 0.1, 0.1), surface(WHITE, 1.0, 0.5), (-0.08, 0.0, 0.055, *UPRIGHT)),
    ]
    many, one = (render_objects(device, *objects, bounces=bounces).radiance for bounces in (32, 1))
    assert many.mean() == pytest.approx(1.0, abs=0.01)
    assert one.mean() < 0.98


def test_russian_roulette_is_unbiased(device, monkeypatch):
    grey = surface(HALF)
    walls = [(box(0.02, 0.3, 0.2), grey, (x, 0.0, 0.1, *UPRIGHT)) for x in (0.03, -0.03)]
    view = camera(8, 24, 200.0, (0.0, 0.0, 2.0))
    means = []
    for roulette in (0, 2, 100):
        monkeypatch.setattr(reference, "ROULETTE", roulette)
        radiance = render_objects(device, (sheet(0.3, 0.3), grey), *walls, samples=1024, bounces=16, view=view).radiance
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
    combined = render_objects(device, *objects, lights=lights, samples=64, light_yaw=0.7).radiance[0]
    noise = {}
    for strategy in (LIGHT_SAMPLING, BRDF_SAMPLING):
        monkeypatch.setattr(reference, "COMBINED", strategy)
        alone = render_objects(device, *objects, lights=lights, samples=128, light_yaw=0.7).radiance[0]
        np.testing.assert_allclose(alone.mean(axis=(0, 1)), combined.mean(axis=(0, 1)), rtol=0.01)
        noise[strategy] = np.abs(alone - combined).mean()
    assert noise[LIGHT_SAMPLING] < noise[BRDF_SAMPLING]


def test_a_mirror_reflects_a_box_above_it(device):
    # A black box 0.5 m above the mirror and 0.2 m to the side: its image appears at 0.2 · 2 / 2.5 m, 16 px from the middle.
    objects = [(sheet(1.0, 1.0), surface(WHITE, 1.0, 0.0)), (box(0.06, 0.06, 0.06), surface((0.0, 0.0, 0.0)), (0.2, 0.0, 0.5, *UPRIGHT))]
    row = render_objects(device, *objects).radiance[0, 24, :, 0]
    assert row[48] < 0.15
    np.testing.assert_allclose(row[16], 1.0, rtol=0.03)


def test_no_light_leaks_through_a_surface(device):
    # The lamp stands below the sheet's plane, but above that of its tilted interpolated normals.
    tilted = sheet(0.6, 0.4)
    tilted.normals[:] = toward(0.7)
    lights = (lamp(-0.3, np.radians(8.0), 100.0),)
    assert render_objects(device, (tilted, surface()), lights=lights).radiance[0, 10:38, 10:54].max() == 0.0
    assert render_objects(device, (sheet(0.6, 0.4), surface()), lights=(lamp(0.3, np.radians(8.0), 100.0),)).radiance[0, 24, 32].min() > 0.1
