"""Path queues: light does not depend on which thread extends a path, nor on whether the queues are full."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from synpick_warp.arrays import allocate_struct
from synpick_warp.configs.schema import FAST, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.lighting.paths.lists import REGION_PIXELS
from synpick_warp.kernels.render.lighting.paths.queues import QUEUE_CAPACITY
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.render.denoised import PATH_QUEUES, interleaved_threads, queue_sizes
from synpick_warp.stages.render.renderer import Renderer
from tests.render.lighting.test_history import show
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, build_scene, camera, entry, even_light, sheet

VIEW = camera(96, 64, 250.0, (0.0, 0.0, 1.5))
LIGHT = EnvironmentMap("gradient", even_light(1.0, 32).radiance * np.linspace(3.0, 0.1, 64, dtype=np.float32)[None, :, None])
FRAMES = 5


def pile(frame: int, bounces: int, walls: bool) -> ToyScene:
    """A sheet, a ball that moves over it, and a box; or walls instead of the box, between which most paths go on."""
    placed = [(0, (0.0, 0.0, 0.0, *UPRIGHT)), (2, (-0.1 + 0.02 * frame, 0.0, 0.06, *UPRIGHT))]
    if walls:
        placed += [(3, (x, 0.0, 0.3, *UPRIGHT)) for x in (-0.11, 0.11)]
    else:
        placed.append((1, (0.05, 0.02, 0.03, *UPRIGHT)))
    entries = [entry(mesh) for mesh in (sheet(0.4, 0.4), box(0.04, 0.04, 0.06), ball(0.03, 3), box(0.02, 0.5, 0.6))]
    render = replace(Config().render, mode=FAST, coarse_pixel=1, coarse_paths=1, bounces=bounces, history=8)
    return ToyScene(entries, [placed], (VIEW,), lights=(LIGHT,), config=Config(render=render))


def make_queues(renderer: Renderer, regions: int) -> Any:
    """Queues of a renderer of one view; 0 regions: none."""
    render = replace(Config().render, bounces=renderer.shading.rules.bounces)  # type: ignore[union-attr]
    sizes = queue_sizes(render, VIEW.width, VIEW.height, 1, renderer.scene.device)
    return allocate_struct(PATH_QUEUES, {"view": 1} | sizes | {"queue_region": regions}, renderer.scene.device)


def light_of(bounces: int, walls: bool, regions: int, device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of all frames, and the number of paths in the first stage's queues after each (frame, region)."""
    each = pile(0, bounces, walls)
    renderer = make_renderer(each.settings(), build_scene(each, device), each.instances, 1, 1)
    renderer.shading.queues = make_queues(renderer, regions)  # type: ignore[union-attr]
    images, counts = [], []
    for image in show(renderer, [(frame, pile(frame, bounces, walls)) for frame in range(FRAMES)], device):
        images.append(image)
        counts.append(renderer.shading.queues.count.numpy()[0, :, 0])  # type: ignore[union-attr]
    return np.stack(images), np.stack(counts)


@pytest.mark.parametrize(("bounces", "walls"), [(1, False), (2, False), (4, False), (4, True), (6, True)])
def test_queued_paths_bring_the_light_of_paths_that_one_thread_traces(device, bounces, walls):
    regions = interleaved_threads(VIEW.width, VIEW.height) // int(REGION_PIXELS)
    alone, _ = light_of(bounces, walls, 0, device)
    queued, counts = light_of(bounces, walls, regions, device)
    # On a GPU the compiler contracts multiplications and additions of the two kernels in different ways.
    np.testing.assert_allclose(queued, alone, rtol=1e-3 if device.is_cuda else 0.0, atol=1e-4 if device.is_cuda else 0.0)
    if bounces == 1:
        assert not counts.any()
    else:
        assert (counts > 0).any(axis=1).all()
    # Between walls more than half of the paths go on.
    assert (2 * counts > int(QUEUE_CAPACITY)).any() == (walls and bounces > 1)
