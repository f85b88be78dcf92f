"""Transparent bodies: what is seen through them, their coats, shadows and truth. Emission of surfaces: it is added to what they reflect, in
units of a picture's white, and lights others."""

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import MAP_CENTER, Glass
from tests.render.lighting.test_dirty_tiles import CAMERAS, ENTRIES, ROOM, play, scripts
from tests.render.lighting.test_shadows import LAMPS
from tests.worlds.shapes import FLAT, UPRIGHT, camera, distorted, even_light, sheet, sun, surface
from tests.worlds.toy_scene import ToyScene, assert_same, build_scene, render_objects, with_render

VIEW = camera(48, 32, 150.0, (0.0, 0.0, 1.0))
PANE = sheet(0.2, 0.12)
RAISED = (0.0, 0.0, 0.1, *UPRIGHT)
INSIDE = (0, slice(12, 20), slice(16, 32))
CHECKS = np.kron(np.indices((8, 8)).sum(axis=0) % 2, np.ones((4, 4)))[..., None].astype(np.uint8) * np.array([255, 255, 255], np.uint8)
EVEN = (even_light(),)
COAT = 0.04
"""Reflectance of the coat at normal incidence."""


def pane(transmission, color=(1.0, 1.0, 1.0), ior=1.5, thickness=0.0):
    return replace(surface(color, roughness=0.3), glass=Glass(transmission, ior, thickness))


def picture(device, material, mode=UNOCCLUDED, mesh=PANE, floor=None, lights=EVEN, view=VIEW, **more):
    below = (sheet(0.6, 0.5), floor or surface(texture=CHECKS))
    placed = [below] if material is None else [below, (mesh, material, RAISED)]
    return render_objects(device, *placed, view=view, config=with_render(mode, samples=64), lights=lights, **more)


@pytest.mark.parametrize("view", [VIEW, distorted(VIEW, -0.2, 0.05, 0.0, 0.0)], ids=["pinhole", "lens"])
@pytest.mark.parametrize("mode", [UNOCCLUDED, FAST, REFERENCE])
def test_clear_glass_vanishes_in_even_light_over_a_white_floor(device, mode, view):
    """What the coat reflects and what passes are all light."""
    with_pane, without = (picture(device, material, mode, floor=surface(), view=view) for material in (pane(1.0, thickness=0.01), None))
    np.testing.assert_allclose(with_pane.radiance[INSIDE], without.radiance[INSIDE], rtol=0.03)


@pytest.mark.parametrize("mode", [UNOCCLUDED, REFERENCE])
def test_a_pane_reflects_and_shows_what_is_behind(device, mode):
    behind = picture(device, None, mode).radiance[INSIDE]
    seen = picture(device, pane(1.0), mode).radiance[INSIDE]
    assert np.ptp(behind) > 0.8
    slope, reflected = np.polyfit(behind.reshape(-1), seen.reshape(-1), 1)
    assert (slope, reflected) == pytest.approx((1.0 - COAT, COAT), abs=0.02)


def test_light_is_linear_in_the_transmission(device):
    half, most, whole = (picture(device, pane(share, (0.2, 0.5, 0.9))).radiance for share in (0.5, 0.75, 1.0))
    np.testing.assert_allclose(most, (half + whole) / 2.0, atol=1e-5)
    assert np.abs(half - whole).max() > 0.1


def test_an_opaque_pane_among_transparent_ones_has_the_bits_of_one_without(device):
    """Also with a drawn transmission of 0, and truth is that of opaque bodies."""
    plain = picture(device, surface(roughness=0.3), FAST)
    drawn = Looks(Randomize(object_transmission=Distribution("fixed", ((0.0,),))), (), ())
    assert_same(picture(device, pane(0.8), FAST, looks=drawn), plain, "color", "radiance", "depth", "instance", "masks", "boxes", "pixels")
    assert_same(picture(device, pane(0.8), FAST), plain, "depth", "exact_depth", "instance", "masks", "boxes", "pixels")


@pytest.mark.parametrize(("transmission", "shadow"), [(0.45, True), (0.55, False)])
def test_bodies_cast_a_shadow_below_half(device, transmission, shadow):
    light = (sun((0.6, 0.0, 0.8)),)
    lit, shaded = (picture(device, material, floor=surface(), lights=light).radiance[0, 14:18] for material in (None, pane(transmission)))
    outside = picture(device, None, floor=surface(), lights=light).instance[0, 14:18] == 1
    outside &= picture(device, pane(transmission), floor=surface(), lights=light).instance[0, 14:18] == 1
    assert (shaded[outside].min() < 0.7 * lit.max()) == shadow
    if not shadow:
        np.testing.assert_array_equal(shaded[outside], lit[outside])


def test_thick_glass_bends_light_as_a_tilted_slab(device):
    """A slab shifts what is behind it by t sin(i) (1 - cos(i) / sqrt(n² - sin²(i))), here along the image."""
    line = surface(texture=np.repeat(np.eye(1, 64, 32, dtype=np.uint8)[..., None] * 255, 3, axis=-1).repeat(4, axis=0))
    tilt, thick = np.radians(40.0), 0.03
    pose = (0.0, 0.0, 0.1, 0.0, np.sin(tilt / 2), 0.0, np.cos(tilt / 2))

    def place(thickness):
        toy = [(sheet(0.6, 0.5), line), (sheet(0.3, 0.2), pane(1.0, thickness=thickness), pose)]
        row = render_objects(device, *toy, view=VIEW, config=with_render(UNOCCLUDED), lights=(even_light(),)).radiance[0, 16, :, 0]
        row = row - np.median(row)
        return (row.clip(0) * np.arange(48)).sum() / row.clip(0).sum()

    shift = thick * np.sin(tilt) * (1.0 - np.cos(tilt) / np.sqrt(1.5**2 - np.sin(tilt) ** 2))
    assert abs(abs(place(thick) - place(0.0)) - 150.0 * shift / 0.95) < 1.0


def test_labels_are_opaque(device):
    """One half of the texture is; USD's and glTF's maps have the same."""
    texture, opacity = np.full((8, 8, 3), 255, np.uint8), np.zeros((8, 8), np.uint8)
    opacity[:, :4] = 255
    half = replace(pane(1.0), texture=texture, opacity=opacity)
    images = [picture(device, each).radiance[INSIDE] for each in (half, surface(roughness=0.3), pane(1.0))]
    label, clear = slice(0, 6), slice(10, 16)
    np.testing.assert_allclose(images[0][:, label], images[1][:, label], atol=1e-3)
    np.testing.assert_allclose(images[0][:, clear], images[2][:, clear], atol=1e-3)


def test_pictures_depend_on_neither_batches_nor_reuse(device):
    """Of bodies that move, appear and disappear, over frames."""
    glass = [
        replace(each, material=replace(each.material, glass=Glass(share))) for each, share in zip(ENTRIES, (0, 0.4, 0.9, 1), strict=True)
    ]
    frames, pictures = scripts(7)[:10], []
    for reuse in (True, False):
        config = with_render(coarse_pixel=2, coarse_paths=1, reuse=reuse)
        toy = ToyScene(glass, frames[0], CAMERAS, lights=(LAMPS,), instances=ROOM, config=config)
        renderer = make_renderer(toy.settings(), build_scene(toy, device), ROOM, 4, histories=4)
        pictures.append(play(renderer, frames, toy, seed=int(reuse))[0])
    for one, other in zip(*pictures, strict=True):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_metals_are_opaque(device):
    metal = replace(pane(1.0), metallic=1.0)
    assert_same(picture(device, metal), picture(device, replace(surface(roughness=0.3), metallic=1.0)), "color")
    texture, maps = np.full((4, 4, 3), 255, np.uint8), np.broadcast_to(np.uint8([MAP_CENTER, MAP_CENTER, 77, 255]), (4, 4, 4))
    mapped = [replace(one, texture=texture, maps=maps) for one in (pane(1.0), surface(roughness=0.3))]
    assert_same(*(picture(device, one) for one in mapped), "color")


# ---- emission ----

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
    """Radiosity: a diffuse white floor reflects the emission of a parallel square times the view factor. The side is twice the distance."""
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
