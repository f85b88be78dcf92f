"""Per-view setup: tile body masks and front-to-back order."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from synpick_warp.stages.render.view_setup import pair_views
from tests.worlds.toy_scene import ToyScene, ball, box, camera, entry, random_pile, random_rotation, render_gbuffer, sheet, views_of


def pile(rng, count: int) -> ToyScene:
    """An object at the origin and others of many shapes at random poses around it, seen from a random camera; some surround the camera."""
    meshes = [box(0.16, 0.07, 0.2), ball(0.06, 2), box(0.3, 0.004, 0.02), sheet(0.2, 0.1), box(0.02, 0.02, 0.02)]
    rotation = random_rotation(rng)
    view = camera(83, 46, rng.uniform(40.0, 250.0), tuple(rotation.T @ (0.0, 0.0, -rng.uniform(0.1, 1.5))), rotation)
    placed = random_pile(rng, len(meshes), count, (-0.4,) * 3, (0.4,) * 3)
    placed[0] = (placed[0][0], (0.0, 0.0, 0.0, *placed[0][1][3:]))
    return ToyScene([entry(mesh) for mesh in meshes], [placed], (view,), instances=count + 2)


def test_views_are_listed_world_by_world_and_camera_by_camera():
    world, camera = pair_views(np.array([1, 4]), np.array([0, 2, 5]))
    assert (world.tolist(), camera.tolist()) == ([1, 1, 1, 4, 4, 4], [0, 2, 5, 0, 2, 5])
    assert world.dtype == camera.dtype == np.int32
    none = pair_views(np.array([], np.int64), np.array([0, 2]))
    assert [len(values) for values in none] == [0, 0]


@pytest.mark.parametrize("seed", range(12))
def test_tile_body_masks_are_conservative(device, seed):
    toy = pile(np.random.default_rng(seed), 14)
    out, renderer = render_gbuffer(toy, device)
    masks = renderer.bodies.body_mask.numpy()[0, :, 0].copy()
    present = renderer.bodies.present.numpy()[0]
    assert present == 14
    expected = {name: getattr(out, name).numpy().copy() for name in ("instance", "depth", "mask_words")}
    renderer.bodies.body_mask.fill_(wp.uint64((1 << 14) - 1))
    renderer.rasterizer.rasterize(renderer.bodies, views_of(toy, device, renderer.cameras), renderer.gbuffer, out)
    for name, image in expected.items():
        np.testing.assert_array_equal(image, getattr(out, name).numpy())
    counts = np.array([int(value).bit_count() for value in masks])
    assert counts.max() <= present
    assert counts.mean() < 0.9 * present
    assert (expected["instance"] > 0).any()


@pytest.mark.parametrize("seed", range(4))
def test_bodies_are_sorted_front_to_back_with_the_tote_last(device, seed):
    toy = pile(np.random.default_rng(seed), 9)
    toy.fixtures_visible = (1, 0, 1)
    _, renderer = render_gbuffer(toy, device)
    mesh, near, order = (getattr(renderer.bodies, name).numpy()[0] for name in ("mesh", "near", "order"))
    present = int(renderer.bodies.present.numpy()[0])
    visible = np.flatnonzero(mesh >= 0)
    assert present == len(visible) == 11
    assert set(order[:present]) == set(visible)
    tote = toy.instances
    others = visible[visible != tote]
    np.testing.assert_array_equal(order[:present], [*others[np.argsort(near[others], kind="stable")], tote])
