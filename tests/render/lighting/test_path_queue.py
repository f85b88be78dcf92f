"""Path queues: packing, and that queued paths have the light of paths that one thread traces to the end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.lighting.paths.lists import REGION_PIXELS
from synpick_warp.kernels.render.lighting.paths.queues import QUEUE_CAPACITY, PathPixel, PathQueues, first_record, read_path, write_path
from synpick_warp.kernels.render.lighting.paths.tracing import Path
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.buffers import allocate_view_buffers
from synpick_warp.stages.render.denoised import PATH_QUEUES, queue_sizes, queue_views
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.sampling_rates import interleaved_threads
from synpick_warp.stages.render.view_setup import make_views
from tests.harness.probe import probe
from tests.render.lighting.test_history import show
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, build_scene, camera, entry, even_light, sheet, snapshot, with_render

VIEW = camera(96, 64, 250.0, (0.0, 0.0, 1.5))
LIGHT = EnvironmentMap("gradient", even_light(1.0, 32).radiance * np.linspace(3.0, 0.1, 64, dtype=np.float32)[None, :, None])
FRAMES = 5
MAX_INTEGERS = {
    "path": {"bounce": 63, "hit.segment": 255, "hit.triangle": (1 << 26) - 1},
    "pixel": {"offset": 511, "segment": 255, "known": 255, "number": (1 << 30) - 1},
}
"""Largest integers of a queued path and of its coarse pixel."""
NOT_QUEUED = {"hit.depth", "unoccluded.indirect"}
"""Members that have no use after a bounce."""


@wp.func
def repack_path(queues: PathQueues, slot: int, path: Path, pixel: PathPixel):
    """Round trip: store a path in a slot of the queue (view 0, region 0), and load it again."""
    write_path(queues, first_record(queues, 0, 0, slot), path, pixel)
    again, place = read_path(queues, first_record(queues, 0, 0, slot))
    return again, place


repack = probe(repack_path)


def pile(frame: int, bounces: int, walls: bool, paths: int) -> ToyScene:
    """A sheet, a ball that moves over it, and a box; or walls instead of the box, between which most paths go on."""
    placed = [(0, (0.0, 0.0, 0.0, *UPRIGHT)), (2, (-0.1 + 0.02 * frame, 0.0, 0.06, *UPRIGHT))]
    if walls:
        placed += [(3, (x, 0.0, 0.3, *UPRIGHT)) for x in (-0.11, 0.11)]
    else:
        placed.append((1, (0.05, 0.02, 0.03, *UPRIGHT)))
    entries = [entry(mesh) for mesh in (sheet(0.4, 0.4), box(0.04, 0.04, 0.06), ball(0.03, 3), box(0.02, 0.5, 0.6))]
    # As many paths as by default: several where no history is usable, one elsewhere.
    config = with_render(coarse_pixel=1, coarse_paths=paths, bounces=bounces, history=8)
    return ToyScene(entries, [placed], (VIEW,), lights=(LIGHT,), config=config)


def make_queues(renderer: Renderer, regions: int, views: int = 1) -> Any:
    """Queues of a renderer for some views at a time; 0 regions: none."""
    render = with_render(bounces=renderer.shading.rules.bounces).render  # type: ignore[union-attr]
    sizes = queue_sizes(render, VIEW.width, VIEW.height, views, 1, renderer.scene.device)
    return allocate_struct(PATH_QUEUES, sizes | {"queue_region": regions, "queue_view": views}, renderer.scene.device)


def light_of(bounces: int, walls: bool, paths: int, regions: int, device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of all frames, and the number of paths in the first stage's queues after each (frame, region)."""
    each = pile(0, bounces, walls, paths)
    renderer = make_renderer(each.settings(), build_scene(each, device), each.instances, 1, 1)
    renderer.shading.queues = make_queues(renderer, regions)  # type: ignore[union-attr]
    images, counts = [], []
    for image in show(renderer, [(frame, pile(frame, bounces, walls, paths)) for frame in range(FRAMES)], device):
        images.append(image)
        counts.append(renderer.shading.queues.count.numpy()[0, :, 0].copy())  # type: ignore[union-attr]
    return np.stack(images), np.stack(counts)


def assert_same_light(queued: np.ndarray, alone: np.ndarray, device: wp.Device) -> None:
    """Compare bit by bit on a CPU. On a GPU the compiler contracts multiplications and additions (FMA) differently in the two kernels, so
    that rounding may change the outcome of a few comparisons."""
    if device.is_cuda:
        assert np.isclose(queued, alone, rtol=1e-3, atol=1e-4).mean() > 0.999
    else:
        np.testing.assert_array_equal(queued, alone)


@pytest.mark.parametrize(
    ("bounces", "walls", "paths"), [(1, False, 1), (2, False, 1), (4, False, 1), (4, True, 1), (6, True, 1), (4, True, 0)]
)
def test_queued_paths_have_the_light_of_paths_traced_by_one_thread(device, bounces, walls, paths):
    regions = interleaved_threads(VIEW.width, VIEW.height) // int(REGION_PIXELS)
    alone, _ = light_of(bounces, walls, paths, 0, device)
    queued, counts = light_of(bounces, walls, paths, regions, device)
    assert_same_light(queued, alone, device)
    # The first frame, in which all coarse pixels trace several paths, queues none.
    assert (counts > 0).any(axis=1).tolist() == [bounces > 1 and (frame > 0 or paths == 1) for frame in range(FRAMES)]
    # Between walls more than half of the paths go on.
    assert (2 * counts > int(QUEUE_CAPACITY)).any() == (walls and bounces > 1 and paths == 1)


def leaves(rows: np.ndarray, prefix: str = "") -> dict[str, np.ndarray]:
    """Members of nested structs by their paths, as views."""
    parts = [
        leaves(rows[name], f"{prefix}{name}.") if rows[name].dtype.names else {f"{prefix}{name}": rows[name]} for name in rows.dtype.names
    ]
    return {name: values for part in parts for name, values in part.items()}


def test_paths_survive_packing(device):
    """Random paths, the first with the largest integers; all but what a queued path has none of."""
    random, count = np.random.default_rng(1), 40
    given = {name: np.zeros(count, np.dtype(kind.numpy_dtype())) for name, kind in (("path", Path), ("pixel", PathPixel))}
    for name, rows in given.items():
        for member, values in leaves(rows).items():
            if largest := MAX_INTEGERS[name].get(member):
                values[:] = random.integers(0, largest + 1, count)
                values[0] = largest
            else:
                values[:] = random.normal(size=values.shape)
    queues = allocate_struct(PATH_QUEUES, queue_sizes(Config().render, VIEW.width, VIEW.height, 1, 1, device) | {"queue_region": 1}, device)
    found = dict(zip(given, repack(queues, np.arange(count), *given.values(), device=device), strict=True))
    for name, rows in given.items():
        again = leaves(found[name])
        for member, values in leaves(rows).items():
            if member not in NOT_QUEUED:
                np.testing.assert_array_equal(again[member], values, err_msg=member)


def test_batches_of_more_views_than_queues_take_turns(device):
    """Three views with queues for two: each has the light that it has without queues."""
    each = pile(0, 4, True, 1)
    renderer = make_renderer(each.settings(), build_scene(each, device), each.instances, 3)
    regions = interleaved_threads(VIEW.width, VIEW.height) // int(REGION_PIXELS)
    zeros = wp.zeros(3, dtype=wp.int32, device=device)
    views, out = make_views(zeros, zeros, 3, 4), allocate_view_buffers(3, VIEW.width, VIEW.height, 4, device)
    images = []
    for count in (0, regions):
        renderer.shading.queues = make_queues(renderer, count, views=2)  # type: ignore[union-attr]
        renderer.render(snapshot(each, device), views, out)
        images.append(renderer.image.radiance.numpy())
    assert_same_light(images[1], images[0], device)


@pytest.mark.parametrize(("views", "gigabytes", "expected"), [(25, 80, 25), (25, 24, 9), (13, 12, 5), (414, 80, 32), (1, 1, 1)])
def test_views_take_turns_of_equal_length(views, gigabytes, expected):
    """Full HD: a view's queues take 20.9 MB."""
    assert queue_views(views, 255, gigabytes << 30) == expected
