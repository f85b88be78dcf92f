"""Masks: the pool of their words, lists of run boundaries and ground truth of views, against loops, NumPy and known answers."""

import dataclasses
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.codes import MAX_INSTANCES, Status
from synpick_warp.configs.schema import UNOCCLUDED
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.bop.shards import ShardsExporter
from synpick_warp.exporters.bop.view import ViewSettings, make_view_task, rotation_matrices
from synpick_warp.exporters.writing.rle import find_run_boundaries, unpack_run_boundaries
from synpick_warp.kernels.render.images.ground_truth import expand_masks_kernel, gather_cameras_kernel, gather_objects_kernel
from synpick_warp.kernels.render.visibility.camera import CameraTable
from synpick_warp.kernels.state import Frames, Snapshots
from synpick_warp.scenes.cameras import CAMERA_KEYS
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import ViewBuffers, allocate_view_buffers, masks_of, view_buffer_sizes
from synpick_warp.stages.online.batches import TruthBuffers
from synpick_warp.stages.render import annotate
from synpick_warp.stages.render.annotate import BoundaryBuffers, BoundaryScratch, boundary_sizes, list_boundaries
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.stream import FrameStream, LightTable, TickReport
from synpick_warp.stages.view_ring import SHARE, CameraGroup, MaskBounds, ViewRing, share_words, split_batches, widen
from synpick_warp.testing.box_views import batches, cameras, config, ends
from synpick_warp.testing.exporters import digests, exporting, finish
from synpick_warp.views.frames import most_words, paint_masks
from tests.harness.aimed_views import aimed_views
from tests.twins.masks import masks_of_batch, pack_into
from tests.worlds.shapes import DOWN, camera
from tests.worlds.toy_scene import ToyScene, build_scene, dense_toy, make_renderer, render_gbuffer, snapshot, with_render

# ---- pool of words ----


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


# ---- run boundaries ----


LENSES = cameras()
SETTINGS = ViewSettings(".jpg", 95, (), masks=True, coco=True, camera={}, resolution=(LENSES[0].width, LENSES[0].height))


def list_on_device(instance: np.ndarray, masks: np.ndarray, device: wp.Device) -> BoundaryBuffers:
    """Lists of ids (B, H, W) and masks (B, I, H, W) bool, of which the last view is not in use."""
    views, rows, columns = instance.shape
    sizes = view_buffer_sizes(views, columns, rows, masks.shape[1])
    images = allocate(ViewBuffers, sizes, device)
    images.instance.assign(instance)
    pack_into(images, masks)
    scratch, out = (allocate(kind, boundary_sizes(sizes), device) for kind in (BoundaryScratch, BoundaryBuffers))
    out.boundary_count.fill_(-1)
    list_boundaries(scratch, views - 1, images, out)
    return out


def sample_blocks(rows: int, columns: int, instances: int = 40, views: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Ids (B, H, W) of random blocks with a few values, and masks (B, I, H, W) bool of such, up to the borders; some are empty."""
    random = np.random.default_rng(7)

    def blocks(*shape: int) -> np.ndarray:
        small = random.integers(0, 4, (*shape, -(-rows // 3), -(-columns // 2)))
        return np.repeat(np.repeat(small, 3, axis=-2), 2, axis=-1)[..., :rows, :columns]

    masks = blocks(views, instances) > 1
    masks[:, ::5] = False
    return np.array([0, 1, 9, 255], np.uint8)[blocks(views)], masks


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (14, 11), (64, 70), (31, 33), (70, 5)])
def test_device_lists_the_same_boundaries_as_numpy(device, shape):
    ids, masks = sample_blocks(*shape)
    lists = list_on_device(ids, masks, device)
    counts, boundaries, run_counts, runs = (getattr(lists, item.name).numpy() for item in fields(lists))
    assert counts[-1] == -1
    assert not run_counts[-1].any()
    for view in range(2):
        expected, found = find_run_boundaries(ids[view]), unpack_run_boundaries(boundaries[view, :, : counts[view]], shape[0])
        for name in ("place", "span", "above", "below"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        edges = np.diff(np.pad(masks[view], ((0, 0), (1, 1), (0, 0))).astype(int), axis=1).swapaxes(1, 2).reshape(len(masks[view]), -1)
        np.testing.assert_array_equal(run_counts[view], np.count_nonzero(edges, axis=1))
        listed = runs[view, : run_counts[view].sum()]
        np.testing.assert_array_equal(listed, edges.nonzero()[1][: runs.shape[1]])


def test_boundaries_beyond_the_capacity_are_counted(device, monkeypatch):
    ids, masks = sample_blocks(14, 11)
    complete = list_on_device(ids, masks[:, :9], device)
    monkeypatch.setattr(annotate, "BOUNDARIES_PER_COLUMN", 1)
    cut = list_on_device(ids, masks[:, :9], device)
    for name in ("boundary_count", "run_count"):
        np.testing.assert_array_equal(getattr(cut, name).numpy(), getattr(complete, name).numpy())
    for count, name in (("boundary_count", "boundaries"), ("run_count", "runs")):
        part = getattr(cut, name).numpy()[:2]
        assert (getattr(cut, count).numpy()[:2].reshape(2, -1).sum(axis=1) > part.shape[-1]).all()
        np.testing.assert_array_equal(part, getattr(complete, name).numpy()[:2, ..., : part.shape[-1]])


def with_boundaries(batch, device):
    """The same views, with lists of run boundaries."""
    masks = np.stack([masks_of_batch(batch, view) for view in range(len(batch))])
    lists = list_on_device(*(np.concatenate((images, images[:1])) for images in (batch.instance, masks)), device)
    return dataclasses.replace(batch, **{item.name: getattr(lists, item.name).numpy()[:-1] for item in fields(lists)})


def test_lists_that_overflowed_or_are_large_are_not_used(device):
    batch = with_boundaries(next(batches(1, (0,), 1, LENSES)), device)
    truth = make_view_task(batch, 0, 0, SETTINGS)[1]
    assert truth.listed
    assert truth.run_count.size
    short = dataclasses.replace(batch, boundaries=batch.boundaries[..., : batch.boundary_count.max() - 1])
    noise = np.random.default_rng(0).integers(0, 256, batch.instance.shape).astype(np.uint8)
    for other in (short, with_boundaries(dataclasses.replace(batch, instance=noise), device)):
        images, truth = make_view_task(other, 0, 0, SETTINGS)
        assert not truth.listed
        assert truth.run_count.size
        assert images[2].dtype == np.uint8
    cut = dataclasses.replace(batch, runs=batch.runs[:, : batch.run_count[0].sum() - 1])
    images, truth = make_view_task(cut, 0, 0, SETTINGS)
    assert truth.listed
    assert not truth.run_count.size
    np.testing.assert_array_equal(images[3], batch.mask_words[0, : batch.mask_length[0]])


@pytest.mark.parametrize("kind", [BopExporter, ShardsExporter])
def test_files_are_the_same_from_lists_and_from_images(tmp_path, device, kind):
    found = []
    for name, change in (("images", lambda batch: batch), ("lists", lambda batch: with_boundaries(batch, device))):
        with exporting(kind, tmp_path / name, config()) as exporter:
            exporter.write_constants()
            for batch in batches(4, (0,), 3, LENSES):
                exporter.write_views(change(batch))
            exporter.end_episode(ends((0,), 3)[0], lambda: None)
            finish(exporter)
        found.append(digests(tmp_path / name))
    assert found[0] == found[1]


# ---- ground truth ----


WORLDS, ROOM, CAMERAS, VIEWS = 4, 3, 2, 7
WORLD = np.array([3, 3, 0, 1, 2, 2, 1], np.int32)
CAMERA = np.array([0, 1, 1, 0, 0, 1, 1], np.int32)
OBJECT_IDS = np.array([4, 7, 11], np.int32)


def gather(device: wp.Device, rotation: np.ndarray, center: np.ndarray, entry: np.ndarray, pose: np.ndarray) -> dict[str, np.ndarray]:
    """Results of both kernels; intrinsics are 100 and 110 c + 0, 1, 2, 3 for camera c; world w shows frame 2 w of episode 20 + w."""
    cameras = CameraTable()
    intrinsics = np.array([[100, 101, 102, 103], [110, 111, 112, 113]], np.float32)
    cameras.intrinsics = wp.array(intrinsics, dtype=wp.vec4, device=device)
    cameras.rotation = wp.array(rotation, dtype=wp.mat33d, device=device)
    cameras.center = wp.array(center, dtype=wp.vec3d, device=device)
    index = np.arange(WORLDS, dtype=np.int32)
    frames, snapshots = Frames(), Snapshots()
    frames.episode, frames.frame = (wp.array(values, dtype=wp.int32, device=device) for values in (20 + index, 2 * index))
    cameras.to_world = wp.zeros(CAMERAS, dtype=wp.mat33, device=device)
    views = aimed_views(WORLD, CAMERA, ROOM, cameras, device)
    out = allocate(TruthBuffers, {"view": VIEWS, "instance": ROOM}, device)
    wp.launch(gather_cameras_kernel, dim=VIEWS, inputs=[frames, views], outputs=[out.bundle], device=device)
    snapshots.catalog_index = wp.array(entry, dtype=wp.int32, device=device)
    snapshots.pose = wp.array(pose, dtype=wp.transformf, device=device)
    inputs = [wp.array(OBJECT_IDS, dtype=wp.int32, device=device), snapshots, views]
    wp.launch(gather_objects_kernel, dim=(VIEWS, ROOM), inputs=inputs, outputs=[out.bundle], device=device)
    return {item.name: getattr(out, item.name).numpy() for item in fields(out)}


@pytest.mark.parametrize("seed", range(3))
def test_poses_equal_their_twin(device, seed):
    rng = np.random.default_rng(seed)
    rotation = rotation_matrices(rng.normal(size=(CAMERAS, 4)))
    center = rng.normal(size=(CAMERAS, 3))
    entry = rng.integers(-1, 3, (WORLDS, ROOM)).astype(np.int32)
    pose = rng.normal(size=(WORLDS, ROOM, 7)).astype(np.float32)
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    made = gather(device, rotation, center, entry, pose)
    assert made["episode"].tolist() == (20 + WORLD).tolist()
    assert made["frame"].tolist() == (2 * WORLD).tolist()
    assert made["camera"].tolist() == CAMERA.tolist()
    assert made["intrinsics"][1].tolist() == [[110, 0, 112], [0, 111, 113], [0, 0, 1]]
    ids, poses = np.append(OBJECT_IDS, -1)[entry[WORLD]], pose[WORLD].astype(np.float64)
    np.testing.assert_array_equal(made["object_id"], ids)
    present = ids >= 0
    assert (made["object_to_camera"][~present] == np.eye(4)).all()
    assert (made["pose"][~present] == [0, 0, 0, 0, 0, 0, 1]).all()
    np.testing.assert_array_equal(made["pose"][present], pose[WORLD][present])
    to_camera = rotation[CAMERA][:, None]
    model = to_camera @ rotation_matrices(poses[..., 3:].reshape(-1, 4)).reshape(VIEWS, ROOM, 3, 3)
    position = (to_camera @ (poses[..., :3] - center[CAMERA][:, None])[..., None])[..., 0]
    np.testing.assert_allclose(made["object_to_camera"][present][:, :3, :3], model[present], rtol=0, atol=2e-7)
    np.testing.assert_allclose(made["object_to_camera"][present][:, :3, 3], position[present], rtol=2e-7, atol=2e-7)
    np.testing.assert_allclose(made["world_to_camera"][:, :3, :3], rotation[CAMERA], atol=1e-7)
    np.testing.assert_allclose(
        made["world_to_camera"][:, :3, 3], -np.squeeze(to_camera @ center[CAMERA][:, None, :, None], (1, 3)), atol=5e-7
    )
    assert (made["world_to_camera"][:, 3] == [0, 0, 0, 1]).all()


def test_masks_equal_their_twin(device):
    rng = np.random.default_rng(0)
    ids = rng.choice(np.array([0, 1, 2, 3, 40, 252, 253, 254, 255], np.uint8), (2, 35, 6))
    masks = rng.integers(0, 2, (2, 40, 35, 6)).astype(bool)
    masks[:, ::3, :, rng.integers(1, 5) :] = False
    masks[:, ::7] = False
    images = allocate_view_buffers(2, 6, 35, 40, device)
    images.instance.assign(ids)
    pack_into(images, masks)
    for hidden, expected in ((False, ids[:, None] == 1 + np.arange(40)[:, None, None]), (True, masks)):
        out = wp.zeros(masks.shape, dtype=wp.bool, device=device)
        inputs = [images.instance, masks_of(images), hidden]
        wp.launch(expand_masks_kernel, dim=out.shape, inputs=inputs, outputs=[out], device=device)
        np.testing.assert_array_equal(out.numpy(), expected)
