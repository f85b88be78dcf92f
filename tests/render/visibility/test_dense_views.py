"""Views of as many instances as ids allow: masks, counts and boxes against float64 rays and NumPy, and words of bodies beyond the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED
from synpick_warp.stages.render import denoised
from synpick_warp.views.frames import most_words
from tests.harness.trace_probe import trace_gbuffer
from tests.twins.annotate import annotated
from tests.twins.raycast import cast_scene
from tests.worlds.toy_scene import (
    UPRIGHT,
    ToyScene,
    assert_same,
    ball,
    box,
    camera,
    entry,
    random_pile,
    render,
    render_gbuffer,
    views_of,
    with_render,
)

VIEW = camera(160, 90, 160.0, (0.0, 0.0, 1.0))
MESHES = (box(0.06, 0.04, 0.03), ball(0.02, 1), box(0.1, 0.015, 0.015))


def pile(count: int, seed: int = 0, **more) -> ToyScene:
    """Small objects above each other, some beyond the border of the image."""
    placed = random_pile(np.random.default_rng(seed), len(MESHES), count, (-0.55, -0.3, -0.15), (0.55, 0.3, 0.15))
    return ToyScene([entry(mesh) for mesh in MESHES], [placed], (VIEW,), **{"instances": MAX_INSTANCES} | more)


@pytest.fixture(scope="module", params=[200, MAX_INSTANCES])
def dense(request):
    return pile(request.param)


def test_masks_agree_with_float64_rays_and_counts_with_masks(device, dense):
    picture, pixels, boxes = annotated(dense, device)
    meshes, poses = [MESHES[index] for index, _ in dense.placed[0]], [pose for _, pose in dense.placed[0]]
    depth, instance, masks = cast_scene(meshes, poses, VIEW)
    seen = masks.any(axis=(1, 2))
    assert seen.sum() > 0.8 * len(meshes)
    for reference, mask in zip(masks, picture.masks[0], strict=False):
        assert (reference != mask).sum() <= 1
    assert (masks != picture.masks[0, : len(masks)]).sum() <= 5
    assert not picture.masks[0, len(masks) :].any()
    assert (picture.instance[0] != instance).sum() <= 5
    assert np.unique(picture.instance).size > 100
    same = (picture.instance[0] == instance) & (instance > 0)
    assert np.quantile(np.abs(picture.exact_depth[0] - depth)[same], 0.999) < 2e-6
    np.testing.assert_array_equal(picture.pixels[0], pixels)
    np.testing.assert_array_equal(picture.boxes[0], boxes)
    assert (boxes[:, 0, 2] >= VIEW.width).any()


def test_words_do_not_grow_with_the_number_of_instances(device, dense):
    """Each mask takes what its box covers, in order, and the capacity is that of masks as large as the image."""
    out, _ = render_gbuffer(dense, device)
    first, box_, length = out.mask_first.numpy()[0], out.mask_box.numpy()[0], int(out.mask_length.numpy()[0])
    sides = np.maximum(box_[:, 2:] - box_[:, :2] + 1, 0)
    words = sides[:, 0] * -(-sides[:, 1] // 32)
    np.testing.assert_array_equal(first, np.cumsum(words) - words)
    assert length == words.sum() < 0.1 * out.mask_words.shape[1]
    assert out.mask_words.shape[1] == MAX_INSTANCES * most_words(VIEW.width, VIEW.height)
    assert not out.mask_words.numpy()[0, length:].any()
    assert (box_[:, :2] >= 0).all()
    assert (box_[:, 2:] < (VIEW.width, VIEW.height)).all()


def test_masks_as_large_as_the_image_fit_the_pool(device):
    """Objects around the camera, whose boxes are the whole image: as many words as there are."""
    around = ToyScene([entry(ball(0.4, 2))], [[(0, (0.01 * index, 0.0, 1.0, *UPRIGHT)) for index in range(3)]], (VIEW,), instances=3)
    out, _ = render_gbuffer(around, device)
    assert out.mask_length.numpy()[0] == out.mask_words.shape[1] == 3 * most_words(VIEW.width, VIEW.height)
    assert render(around, device, colors=False).masks.all()


def test_rays_meet_the_bodies_of_all_words(device, dense):
    toy = replace(dense, fixtures_visible=(0, 1, 1), fixture_poses=tuple((0.1 * index, 0.1, 0.2, *UPRIGHT) for index in range(3)))
    _, renderer = render_gbuffer(toy, device)
    names = ("segment", "triangle", "barycentric", "depth")
    raster = {name: getattr(renderer.gbuffer, name).numpy().copy() for name in names}
    assert renderer.bodies.body_mask.shape[2] == 4
    trace_gbuffer(renderer.scene, renderer.bodies, views_of(toy, device, renderer.cameras), renderer.gbuffer, 1)
    same = raster["segment"] == renderer.gbuffer.segment.numpy()
    assert (~same).sum() <= 3
    np.testing.assert_allclose(renderer.gbuffer.depth.numpy()[same], raster["depth"][same], rtol=1e-5)


@pytest.mark.parametrize("mode", [FAST, REFERENCE, UNOCCLUDED])
def test_pictures_do_not_depend_on_the_room_for_instances(device, mode):
    config = with_render(mode, samples=2) if mode == REFERENCE else with_render(mode)
    few, many = (render(pile(14, 3, instances=room, config=config, fixtures_visible=(0, 1, 0)), device) for room in (14, MAX_INSTANCES))
    assert_same(few, many, "color", "depth", "instance", "exact_depth", "radiance", "resolve")
    for name in ("masks", "pixels", "boxes"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:, :14])


@pytest.mark.parametrize("count", [60, 61, 62])
def test_bodies_about_the_end_of_a_word_are_anti_aliased_alike(device, count):
    """With fixtures 63, 64 and 65 bodies, all in the image: one word with a free bit, and two."""
    fixtures = {"fixtures_visible": (1, 1, 1), "fixture_poses": tuple((0.2 * index, 0.1, -0.3, *UPRIGHT) for index in range(3))}
    exact, wide = (render(pile(count, 4, instances=room, config=with_render(UNOCCLUDED), **fixtures), device) for room in (count, 200))
    assert_same(exact, wide, "color", "instance", "resolve")


def test_coverage_rays_meet_the_bodies_of_later_words(device, monkeypatch):
    """Objects beside the image, nearer to the camera, take the first ranks; those in the image are in the last word."""
    seen = pile(20, 5, config=with_render(UNOCCLUDED))
    beside = [(1, (50.0, 0.01 * index, 0.5, *UPRIGHT)) for index in range(220)]
    crowded = replace(seen, placed=[seen.placed[0] + beside])
    alone, among = render(seen, device), render(crowded, device)
    assert_same(among, alone, "instance", "resolve")
    assert (alone.resolve != 0).sum() > 100
    monkeypatch.setattr(denoised, "crowd_of", lambda _: denoised.ManyBodies())
    assert (render(crowded, device).resolve != among.resolve).any()
