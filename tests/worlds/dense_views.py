"""Views of many boxes: placed at random, without physics, and rendered by the renderer, with the lists of their runs."""

from __future__ import annotations

import numpy as np
import warp as wp

from synpick_warp.codes import Effect
from synpick_warp.configs.schema import Bop, Config
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import allocate_view_buffers, view_buffer_sizes
from synpick_warp.stages.render.mask_runs import BoundaryBuffers, BoundaryScratch, boundary_sizes, list_boundaries
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.testing.box_views import catalog
from synpick_warp.views.frames import FrameBatch
from tests.worlds.shapes import random_pile
from tests.worlds.toy_scene import ToyScene, build_scene, make_renderer, snapshot


def dense_toy(count: int, lenses: tuple[Camera, ...], room: int, seed: int = 0) -> ToyScene:
    """A world of `count` boxes of the catalog of `box_views`, in a heap that reaches beyond the images."""
    placed = random_pile(np.random.default_rng(seed), 2, count, (-0.4, -0.3, -0.2), (0.4, 0.3, 0.1))
    return ToyScene(list(catalog().entries), [placed], lenses, instances=room, config=Config(bop=Bop(depth_scale=0.1)))


def dense_batch(toy: ToyScene, device: wp.Device) -> FrameBatch:
    """The world's views by all cameras, as frame 0 of episode 0, with run boundaries."""
    scene, count = build_scene(toy, device), len(toy.cameras)
    renderer = make_renderer(toy.settings(), scene, toy.instances, count)
    out = allocate_view_buffers(count, scene.width, scene.height, toy.instances, device)
    world = snapshot(toy, device)
    renderer.render(world, first_views(count, count, toy.instances, device), out)
    sizes = boundary_sizes(view_buffer_sizes(count, scene.width, scene.height, toy.instances))
    scratch, boundaries = (allocate(kind, sizes, device) for kind in (BoundaryScratch, BoundaryBuffers))
    list_boundaries(scratch, count, out, boundaries)
    entries = world.catalog_index.numpy()[0]
    ids = np.append([entry.obj_id for entry in toy.entries], -1)[entries].astype(np.int32)
    images = {name: array.numpy() for name, array in (vars(out) | vars(boundaries)).items() if name not in ("effects", "bundle")}
    return FrameBatch(
        **images,
        episode=np.zeros(count, np.int32),
        camera=np.arange(count, dtype=np.int32),
        frame=np.zeros(count, np.int32),
        time=np.zeros(count),
        object_id=np.tile(ids, (count, 1)),
        pose=np.tile(world.pose.numpy()[0], (count, 1, 1)),
        effects=np.zeros((count, len(Effect)), np.float32),
        light_name=np.full(count, "even"),
        light_yaw=np.zeros(count, np.float32),
        light_exposure=np.zeros(count, np.float32),
        light_direction=np.zeros((count, 3), np.float32),
    )
