"""Mode unoccluded: unoccluded environment light, and sun shadows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED
from synpick_warp.stages.render.denoised import history_sizes, scratch_sizes
from tests.online.conftest import tiny
from tests.render.lighting.test_denoised import HALF, clutter, psnr, render_objects
from tests.worlds.toy_scene import UPRIGHT, WHITE, ball, box, camera, even_light, lamp, sheet, surface, with_render


@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.7), (1.0, 0.25), (1.0, 1.0)])
def test_white_furnace(device, metallic, roughness):
    view = camera(128, 96, 500.0, (0.0, 0.0, 2.0))
    objects = (ball(0.1, 4), surface(WHITE, metallic, roughness))
    picture = render_objects(device, objects, lights=(even_light(2.0),), view=view, config=with_render(UNOCCLUDED))
    np.testing.assert_allclose(picture.radiance[0][picture.instance[0] == 1].mean(axis=0), 2.0, rtol=0.01)


def test_walls_do_not_darken_a_floor(device):
    """The floor between two high walls has the radiance of an open one; in mode fast it is darker."""
    floor = (sheet(0.6, 0.5), surface(HALF))
    walls = [(box(0.02, 0.4, 0.3), surface((0.1,) * 3), (x, 0.0, 0.15, *UPRIGHT)) for x in (-0.1, 0.1)]
    view = camera(64, 48, 600.0, (0.0, 0.0, 2.0))
    unoccluded, alone, fast = (
        picture.radiance[0][picture.instance[0] == 1].mean()
        for picture in (
            render_objects(device, floor, *walls, view=view, config=with_render(UNOCCLUDED)),
            render_objects(device, floor, view=view, config=with_render(UNOCCLUDED)),
            render_objects(device, floor, *walls, view=view, config=with_render(FAST, coarse_paths=16)),
        )
    )
    np.testing.assert_allclose(unoccluded, alone, rtol=1e-5)
    assert fast < 0.8 * unoccluded


def test_sunlight_and_shadows_are_those_of_the_reference(device):
    """Under a lamp without sky, and one bounce: a box on a plane and its shadow."""
    light = lamp(0.7, np.radians(1.5), 300.0)
    objects = [(sheet(0.6, 0.5), surface(HALF)), (box(0.1, 0.1, 0.1), surface(HALF), (0.0, 0.0, 0.05, *UPRIGHT))]
    pictures = [
        render_objects(device, *objects, lights=(light,), config=config)
        for config in (with_render(UNOCCLUDED), with_render(REFERENCE, samples=64, bounces=1))
    ]
    unoccluded, reference = (picture.radiance[0] for picture in pictures)
    on_surface = pictures[0].instance[0] > 0
    lit, visible = np.median(reference[on_surface]), cv2.erode(on_surface.astype(np.uint8), np.ones((3, 3))) > 0
    shadow = cv2.erode((visible & (reference.mean(axis=2) < 0.2 * lit)).astype(np.uint8), np.ones((3, 3))) > 0
    assert shadow.sum() > 20
    assert unoccluded[shadow].max() < 0.3 * lit  # Unoccluded light is at least 5 % of the mean of the map.
    assert psnr(unoccluded, reference) > 43.0


def test_annotations_are_those_of_the_other_modes(device):
    view = camera(160, 120, 300.0, (0.0, 0.0, 1.0))
    unoccluded, fast = (render_objects(device, *clutter(), view=view, config=with_render(mode)) for mode in (UNOCCLUDED, FAST))
    for name in ("depth", "instance", "amodal", "pixels", "boxes"):
        np.testing.assert_array_equal(getattr(unoccluded, name), getattr(fast, name))
    assert psnr(unoccluded.radiance, fast.radiance) > 20.0


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


def test_a_stream_of_the_mode(device):
    """The objects of the first views have the colors of their textures under the map."""
    with synpick_warp.stream(tiny(render__mode=UNOCCLUDED), device=str(device)) as stream:
        batch = next(stream)
        colors = batch.color.numpy()[batch.instance.numpy() > 0]
    assert (colors.mean(axis=0) > 10.0).all()
    assert len(np.unique(colors, axis=0)) > 5
