"""Pool of mask words: bounds against the words that the renderer lays out, batches against a loop, and views of any division alike."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synpick_warp.codes import MAX_INSTANCES, Status
from synpick_warp.configs.schema import UNOCCLUDED
from synpick_warp.scenes.cameras import CAMERA_KEYS
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.buffers import ViewBuffers, allocate_view_buffers, view_buffer_sizes
from synpick_warp.stages.mask_pool import SHARE, MaskBounds, share_words, split_batches, widen
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.stream import FrameStream, LightTable, TickReport
from synpick_warp.stages.view_ring import CameraGroup, ViewRing
from synpick_warp.views.frames import most_words, paint_masks
from tests.worlds.dense_views import dense_toy
from tests.worlds.toy_scene import DOWN, ToyScene, build_scene, camera, make_renderer, render_gbuffer, snapshot, with_render

WIDTH, HEIGHT = 96, 50
FAR_AWAY, NEAR, AMONG = (camera(WIDTH, HEIGHT, focal, (0.0, 0.0, height)) for focal, height in ((60.0, 1.5), (90.0, 0.5), (60.0, 0.05)))


def aimed(seed: int) -> Camera:
    """A camera in or around the heap, turned at random."""
    rng = np.random.default_rng(seed)
    return camera(WIDTH, HEIGHT, rng.uniform(40.0, 150.0), tuple(rng.uniform(-0.8, 0.8, 3)), Rotation.random(rng=rng).as_matrix() @ DOWN)


def bounds_of(scene, cameras: tuple[Camera, ...]) -> MaskBounds:
    return MaskBounds.of(scene.meshes, cameras)


def placed_in(toy: ToyScene, device) -> tuple[np.ndarray, np.ndarray]:
    world = snapshot(toy, device)
    return world.catalog_index.numpy(), world.pose.numpy()


@pytest.mark.parametrize("lens", [FAR_AWAY, NEAR, AMONG, *map(aimed, range(6))])
def test_bounds_are_above_the_words_of_a_view_and_not_far_above(device, lens):
    toy = dense_toy(150, (lens,), 200)
    out, _ = render_gbuffer(toy, device)
    placed = {key: getattr(lens, key)[None] for key in CAMERA_KEYS}
    index, pose = placed_in(toy, device)
    (bound,) = bounds_of(build_scene(toy, device), toy.cameras).count_words(index, pose, placed)
    used = int(out.mask_length.numpy()[0])
    assert used <= bound <= 150 * most_words(WIDTH, HEIGHT)
    if lens is FAR_AWAY:
        assert 0 < bound < 4 * used
    pose[0, 3] = np.nan
    (worse,) = bounds_of(build_scene(toy, device), toy.cameras).count_words(index, pose, placed)
    assert worse <= bound + most_words(WIDTH, HEIGHT)
    assert worse >= most_words(WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("views", "instances", "masks"), [(25, 10, 10), (25, 150, SHARE), (3, MAX_INSTANCES, 84), (1, MAX_INSTANCES, MAX_INSTANCES)]
)
def test_a_pool_has_room_for_all_masks_of_a_view(views, instances, masks):
    share = share_words(views, instances, WIDTH, HEIGHT)
    assert share == masks * most_words(WIDTH, HEIGHT)
    assert views * share >= instances * most_words(WIDTH, HEIGHT)


def test_batches_keep_the_order_and_hold_views_of_a_kind():
    rng = np.random.default_rng(0)
    for views, wide in ((1, 1), (4, 1), (5, 3)):
        words = rng.integers(1, 3, 40)
        parts = list(split_batches(words, 1, views, wide))
        assert [view for part, _ in parts for view in range(part.start, part.stop)] == list(range(40))
        for part, is_wide in parts:
            assert set(words[part] > 1) == {is_wide}
            assert part.stop - part.start <= (wide if is_wide else views)
    assert list(split_batches(np.zeros(7, np.int64), 0, 3, 1)) == [(slice(0, 3), False), (slice(3, 6), False), (slice(6, 7), False)]
    assert not list(split_batches(np.zeros(0, np.int64), 0, 3, 1))


def stream_of(toy: ToyScene, device, views: int, words: int | None) -> FrameStream:
    """A stream of the worlds of a scene; `words`: a view's share of the pool, None: room for all masks."""
    scene, sizes = build_scene(toy, device), view_buffer_sizes(views, WIDTH, HEIGHT, toy.instances)
    bounds = None if words is None else bounds_of(scene, toy.cameras)
    group = CameraGroup(
        tuple(range(len(toy.cameras))),
        sizes if words is None else sizes | {"mask_word": words},
        make_renderer(toy.settings(), scene, toy.instances, views),
        bounds=bounds,
    )
    lights = LightTable(np.array(["even"]), np.zeros((1, 3), np.float32))
    return FrameStream([ViewRing(group, (), device)], 0.1, np.arange(2), lights, device)


def report_of(toy: ToyScene, device) -> TickReport:
    worlds, (index, pose) = len(toy.placed), placed_in(toy, device)
    status = np.zeros((worlds, len(Status)), np.int32)
    status[:, Status.LIVE], status[:, Status.EPISODE] = 1, np.arange(worlds)
    light = SimpleNamespace(light=np.zeros(worlds, np.int32), light_yaw=np.zeros(worlds), light_exposure=np.zeros(worlds))
    none = np.zeros((worlds, 1))
    return TickReport(status, none, none, none, index, pose, SimpleNamespace(), SimpleNamespace(), light)


def views_of(stream: FrameStream, toy: ToyScene, device) -> tuple[list[dict[str, np.ndarray]], list[int]]:
    """Every view's arrays, with masks as images, and the sizes of the batches."""
    views, sizes = [], []
    for batch in stream.render(snapshot(toy, device), report_of(toy, device)):
        sizes.append(len(batch))
        for view in range(len(batch)):
            runs = batch.runs[view, : batch.run_count[view].sum()].copy()
            masks = paint_masks(batch.mask_words[view], batch.mask_first[view], batch.mask_box[view], WIDTH, HEIGHT)
            own = {name: getattr(batch, name)[view].copy() for name in ("color", "depth", "instance", "pixels", "boxes", "run_count")}
            views.append(own | {"masks": masks, "runs": runs, "mask_words": batch.mask_words[view, : batch.mask_length[view]].copy()})
    return views, sizes


def test_views_beyond_their_share_are_rendered_alike_in_smaller_batches(device):
    """Of three worlds with 60 objects, the near camera's views need a wide batch; no byte depends on how the pool is divided."""
    cameras = (FAR_AWAY, NEAR)
    worlds = [dense_toy(60, cameras, 64, seed).placed[0] for seed in range(3)]
    toy = replace(dense_toy(60, cameras, 64), placed=worlds, config=with_render(UNOCCLUDED))
    index, pose = placed_in(toy, device)
    bounds = bounds_of(build_scene(toy, device), cameras)
    far, near = (bounds.count_words(index, pose, {key: np.stack([getattr(one, key)] * 3) for key in CAMERA_KEYS}).max() for one in cameras)
    assert far < near
    most, share = 64 * most_words(WIDTH, HEIGHT), int(far)
    views = -(-2 * most // share)
    alone, batches = views_of(stream_of(toy, device, 6, None), toy, device)
    divided, parts = views_of(stream_of(toy, device, views, share), toy, device)
    assert batches == [6]
    assert parts == [1] * 6
    for left, right in zip(alone, divided, strict=True):
        for name, value in left.items():
            np.testing.assert_array_equal(value, right[name], err_msg=name)
    assert all(view["masks"].any(axis=(1, 2)).sum() > 30 for view in divided)


def test_masks_beyond_the_pool_are_told(device):
    """Bounds that are too low, which no pose gives: nothing is written beyond the pool, and the host tells it."""
    toy = replace(dense_toy(60, (FAR_AWAY,), 64), config=with_render(UNOCCLUDED))
    stream = stream_of(toy, device, 20, 200)
    low = replace(stream.rings[0].group.bounds, radius=np.full(3, -1.0))
    stream.rings[0].group = replace(stream.rings[0].group, bounds=low)
    with pytest.raises(RuntimeError, match="more words than their bound"):
        list(stream.render(snapshot(toy, device), report_of(toy, device)))
    out = allocate_view_buffers(1, WIDTH, HEIGHT, 64, device)
    renderer = make_renderer(toy.settings(), build_scene(toy, device), 64, 1)
    full, _ = render_gbuffer(toy, device)
    pool = out.mask_words.flatten()
    pool.fill_(7)
    renderer.render_gbuffer(snapshot(toy, device), first_views(1, 1, 64, device), replace(out, mask_words=pool[:200].reshape((1, 200))))
    assert (pool.numpy()[200:] == 7).all()
    assert out.mask_length.numpy()[0] == full.mask_length.numpy()[0] > 200
    fits = full.mask_first.numpy()[0] + 0 * full.mask_box.numpy()[0, :, 0] < 200
    np.testing.assert_array_equal(out.mask_first.numpy(), full.mask_first.numpy())
    assert (out.mask_box.numpy()[0][~fits] == (0, 0, -1, -1)).all()


def test_a_wide_pool_is_the_same_memory(device):
    images: ViewBuffers = allocate_view_buffers(1, WIDTH, HEIGHT, 40, device)
    pool = replace(images, mask_words=images.mask_words.flatten().reshape((4, 10 * most_words(WIDTH, HEIGHT))))
    wide = widen(pool)
    assert wide.mask_words.shape == (1, 40 * most_words(WIDTH, HEIGHT))
    assert wide.mask_words.ptr == images.mask_words.ptr
