"""From ticks to frame batches: which views, in which order, in which batches, with what in them; selections of ticks, waits for copies."""

import dataclasses
import itertools
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import MAX_INSTANCES, Effect, Measure, Phase, Status
from synpick_warp.configs.cell.cameras import CameraRow
from synpick_warp.configs.schema import LAYERS, Config
from synpick_warp.exporters.writing.rle import find_run_boundaries, unpack_run_boundaries
from synpick_warp.stages import view_ring
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, ViewBuffers, view_buffer_sizes
from synpick_warp.stages.perception.images import Observation, Plan
from synpick_warp.stages.render.annotate import FIELDS, boundary_sizes
from synpick_warp.stages.render.scene import build_lights
from synpick_warp.stages.sim import worlds
from synpick_warp.stages.sim.simulate import TickRecord
from synpick_warp.stages.stream import FrameStream, LightTable, TickReport, name_lights, read_tick, tick_batch
from synpick_warp.stages.view_ring import CameraGroup, HostCopy, ViewRing, view_sizes, views_per_batch
from synpick_warp.system.codecs.jpeg import encode_jpeg
from synpick_warp.views.frames import FrameBatch, SelectedRows
from tests.twins.encodings import encode_depth
from tests.worlds.shapes import even_light, sun
from tests.worlds.small_worlds import settings
from tests.worlds.trajectories import ticks

WORLDS, ROOM = 5, 3
OBJECT_IDS = np.array([4, 7, 11], np.int32)
LIGHTS = LightTable(np.array(["lamp", "even"]), np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 0.0]], np.float32))


@dataclass
class FakeRenderer:
    """Writes into each view which world and camera it was made for, and lays out no masks; remembers how it was called."""

    calls: list[tuple[Any, list[int], list[int], int]]

    def render(self, snapshot, views, out, layers, placed=None) -> None:
        world, camera, count = views.world.numpy(), views.camera.numpy(), views.count
        self.calls.append((snapshot, world.tolist(), camera.tolist(), count))
        shown = [array for name, array in vars(out).items() if name not in ("mask_first", "mask_box", "mask_length")]
        for array in (*shown, *(array for array in vars(layers).values() if array is not None)):
            values = array.numpy()
            shape = (count,) + (1,) * (values.ndim - 1)
            values[:count] = (10 * world[:count] + camera[:count] + 1).reshape(shape)
            array.assign(values)


def batch_of(config: Config, device: Any) -> int:
    return views_per_batch(config.render, config.rig, config.bake.worlds, config.arrangement.max_objects, device)


def config_of(**overrides: object):
    return settings(bake__worlds=WORLDS, arrangement__max_objects=ROOM, cameras__resolution=[8, 6], **overrides)


def report_of(live: list[int]) -> TickReport:
    """Worlds as `live` says; world w has episode 20 + w, frame 2 w, entries w mod 4 - 1, ..., and poses of its own."""
    status = np.zeros((WORLDS, len(Status)), np.int32)
    number = np.arange(WORLDS)
    for name, values in {"live": live, "episode": 20 + number, "frame": 2 * number}.items():
        status[:, Status[name.upper()]] = values
    entry = ((number[:, None] + np.arange(ROOM)) % 4 - 1).astype(np.int32)
    pose = np.arange(WORLDS * ROOM * 7, dtype=np.float32).reshape(WORLDS, ROOM, 7)
    measures = np.zeros((WORLDS, len(Measure)), np.float32)
    light = SimpleNamespace(light=number % 2, light_yaw=0.5 * number.astype(np.float32), light_exposure=0.1 * number.astype(np.float32))
    nobody = np.zeros((WORLDS, 1), np.uint32)
    return TickReport(status, measures, nobody, nobody, entry, pose, SimpleNamespace(), SimpleNamespace(), light)


def sizes_of(config: Config, device: wp.Device) -> dict[str, int]:
    return view_sizes(config.render, config.rig, config.bake.worlds, config.arrangement.max_objects, device)


def frame_stream(config: Config, renderer: FakeRenderer, device, host: view_ring.TransferSettings | None = None) -> FrameStream:
    group = CameraGroup(config.rig.groups[0], sizes_of(config, device), renderer)  # type: ignore[arg-type]
    return FrameStream([ViewRing(group, config.render.layers, device, host)], config.physics.tick_time, OBJECT_IDS, LIGHTS, device)


def rendered(device, live: list[int], batch: int, **overrides: object) -> tuple[list[dict[str, Any]], FakeRenderer]:
    renderer = FakeRenderer([])
    frames = frame_stream(config_of(render__views_per_batch=batch, **overrides), renderer, device)
    return [copied(made) for made in frames.render("snapshot", report_of(live))], renderer


def copied(batch: FrameBatch) -> dict[str, Any]:
    arrays = {name: np.array(value) for name, value in vars(batch).items() if name != "layers"}
    # What follows the end of a list is of no meaning.
    for runs, counts in zip(arrays["runs"], arrays["run_count"], strict=True):
        runs[counts.sum() :] = 0
    return arrays | {"layers": {name: value.copy() for name, value in batch.layers.items()}, "length": len(batch)}


@pytest.mark.parametrize("live", [[1, 1, 1, 1, 1], [0, 1, 0, 1, 1], [0, 0, 0, 0, 1], [0, 0, 0, 0, 0]])
@pytest.mark.parametrize("batch", [1, 2, 3, 4, 7, 100])
def test_live_views_come_world_by_world_and_camera_by_camera(device, live, batch):
    batches, renderer = rendered(device, live, batch)
    expected = [(world, camera) for world in np.flatnonzero(live) for camera in range(3)]
    views = [(int(episode) - 20, int(camera)) for made in batches for episode, camera in zip(made["episode"], made["camera"], strict=True)]
    assert views == expected
    assert [made["length"] for made in batches] == [min(batch, len(expected) - first) for first in range(0, len(expected), batch)]
    for made, (snapshot, world, camera, count) in zip(batches, renderer.calls, strict=True):
        assert snapshot == "snapshot"
        assert count == made["length"]
        assert len(world) == len(camera) == batch
        # What pads the batch must be worlds and cameras that exist.
        assert world[count:] == camera[count:] == [0] * (batch - count)
        code = 10 * (made["episode"] - 20) + made["camera"] + 1
        for name in ("color", "depth", "instance", "mask_words", "pixels", "boxes", "effects"):
            assert len(made[name]) == count
            assert (made[name].reshape(count, -1) == code[:, None]).all(), name


@pytest.mark.parametrize("reserved", [[0.2, 0.2, 0.2], [0.2, 0.0, 0.1, 0.2], [0.0, 0.0, 0.1]])
def test_batches_are_the_same_on_a_part_of_the_multiprocessors(device, reserved):
    frames, views, expected = frame_stream(config_of(render__views_per_batch=2), FakeRenderer([]), device), [], []
    for tick, share in enumerate(reserved):
        frames.streams.confine(share)
        views += [copied(batch) for batch in frames.advance("snapshot", report_of([tick % 2, 1, 0, tick // 2, 1]))]
        expected += rendered(device, [tick % 2, 1, 0, tick // 2, 1], 2)[0]
    np.testing.assert_equal(views + [copied(batch) for batch in frames.drain()], expected)


def test_layers_come_if_they_are_asked_for_each_with_its_views(device):
    (made,), _ = rendered(device, [0, 1, 0, 0, 1], 100)
    assert made["layers"] == {}
    batches, _ = rendered(device, [0, 1, 0, 0, 1], 4, render__layers=["scene_flow", "normals", "classes", "albedo"])
    code = iter([11, 12, 13, 41, 42, 43])
    for made in batches:
        layers = made["layers"]
        # The order is that of the declaration, whatever that of the setting.
        assert list(layers) == [name for name in LAYERS if name in layers] == ["normals", "albedo", "classes", "scene_flow"]
        assert [layers[name].dtype.name for name in layers] == ["float32", "uint8", "uint16", "float32"]
        assert [layers[name].shape[1:] for name in layers] == [(6, 8, 3), (6, 8, 3), (6, 8), (6, 8, 3)]
        for view in range(made["length"]):
            expected = next(code)
            assert all((array[view] == expected).all() for array in layers.values())


def test_what_a_batch_says_of_its_views(device):
    (made,), _ = rendered(device, [0, 1, 0, 0, 1], 100)
    config = config_of()
    tick = config.physics.step * config.physics.steps_per_tick
    world = np.repeat([1, 4], 3)
    known = report_of([0] * WORLDS)
    np.testing.assert_array_equal(made["episode"], 20 + world)
    np.testing.assert_array_equal(made["frame"], 2 * world)
    np.testing.assert_allclose(made["time"], 2 * world * tick, rtol=1e-12)
    np.testing.assert_array_equal(made["pose"], known.pose[world])
    ids = np.where(known.catalog_index >= 0, OBJECT_IDS[known.catalog_index], -1)
    np.testing.assert_array_equal(made["object_id"], ids[world])
    assert ids.min() == -1
    assert {made[name].dtype.name for name in ("episode", "camera", "frame", "object_id", "pixels", "boxes")} == {"int32"}
    kinds = {"time": "float64", "pose": "float32", "color": "uint8", "depth": "uint16", "instance": "uint8", "mask_words": "uint32"}
    assert {name: made[name].dtype.name for name in kinds} == kinds
    assert made["light_name"].tolist() == ["even"] * 3 + ["lamp"] * 3
    np.testing.assert_allclose(made["light_yaw"], 0.5 * world)
    np.testing.assert_allclose(made["light_exposure"], 0.1 * world, rtol=1e-6)
    np.testing.assert_allclose(made["light_direction"][3], [0.6 * np.cos(2.0), 0.6 * np.sin(2.0), 0.8], rtol=1e-6)
    assert not made["light_direction"][:3].any()
    assert made["effects"].shape == (6, len(Effect))
    assert made["color"].shape == (6, 6, 8, 3)
    assert made["boxes"].shape == (6, ROOM, 2, 4)


def test_what_a_tick_says_of_its_live_worlds():
    known = report_of([0, 1, 0, 0, 1])
    numbers = np.arange(WORLDS, dtype=np.float32)
    fixtures = np.arange(WORLDS * 21, dtype=np.float32).reshape(WORLDS, 3, 7)
    known = dataclasses.replace(
        known,
        snapshot=SimpleNamespace(
            bin=np.zeros(len(fixtures), np.int32),
            fixture_pose=fixtures,
            fixture_visible=np.arange(15).reshape(WORLDS, 3),
            light=numbers,
            light_yaw=numbers / 2,
            light_exposure=-numbers,
        ),
        tick={"speed": numbers[:, None]},
        steps={"force": np.repeat(numbers[:, None], 4, axis=1)},
    )
    batch = tick_batch(known, OBJECT_IDS, 0.25)
    live = [1, 4]
    assert len(batch) == 2
    assert (batch.episode.tolist(), batch.frame.tolist(), batch.time.tolist()) == ([21, 24], [2, 8], [0.5, 2.0])
    np.testing.assert_array_equal(batch.pose, known.pose[live])
    np.testing.assert_array_equal(batch.object_id, np.where(known.catalog_index >= 0, OBJECT_IDS[known.catalog_index], -1)[live])
    np.testing.assert_array_equal(batch.fixture_pose, fixtures[live])
    assert batch.fixture_visible.tolist() == [[3, 4, 5], [12, 13, 14]]
    assert (batch.light.tolist(), batch.light_yaw.tolist(), batch.light_exposure.tolist()) == ([1, 4], [0.5, 2.0], [-1, -4])
    assert batch.tick["speed"].tolist() == [[1.0], [4.0]]
    assert batch.steps["force"].tolist() == [[1.0] * 4, [4.0] * 4]


def test_a_tick_that_is_stopped_early_leaves_nothing_behind(device):
    """Whoever stops reading a tick's batches gets the next tick's from its first."""
    frames = frame_stream(config_of(render__views_per_batch=2), FakeRenderer([]), device)
    next(frames.render("first", report_of([1] * WORLDS)))
    batches = frames.render("second", report_of([0, 0, 1, 0, 0]))
    assert [int(episode) for made in batches for episode in made.episode] == [22, 22, 22]


def test_ticks_follow_each_other_without_a_gap(device):
    """Batches in flight are those of one tick at most, come in order with their own images, and a tick ends behind its last."""
    frames = frame_stream(config_of(render__views_per_batch=2), FakeRenderer([]), device)
    events: list[object] = []
    ticks = [[1, 1, 1, 1, 1], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0], [1, 0, 0, 0, 1], [0, 1, 0, 0, 0]]
    for tick, live in enumerate(ticks):
        for made in frames.advance("snapshot", report_of(live), partial(events.append, f"end of {tick}")):
            world = made.episode - 20
            assert (np.asarray(made.color[:, 0, 0, 0]) == 10 * world + made.camera + 1).all()
            events += world.tolist()
        assert tick == 0 or f"end of {tick - 1}" in events
    left = len(frames.in_flight)
    assert left == (2 if device.is_cuda else 0)
    for made in frames.drain():
        events += (made.episode - 20).tolist()
    expected = [[*np.repeat(np.flatnonzero(live), 3).tolist(), f"end of {tick}"] for tick, live in enumerate(ticks)]
    assert events == list(itertools.chain.from_iterable(expected))


# ---- sizes ----


def test_batch_sizes():
    cpu = SimpleNamespace(is_cuda=False)
    assert batch_of(config_of(), cpu) == 3
    assert batch_of(config_of(render__views_per_batch=17), cpu) == 17
    gpu = SimpleNamespace(is_cuda=True)
    assert batch_of(config_of(), gpu) == 3 * WORLDS
    for layers, size in (([], 0), (LAYERS, 12 + 3 + 12 + 2 + 8 + 12 + 2 + 1 + 1 + 2)):
        count = batch_of(settings(bake__worlds=1000, cameras__resolution=[1920, 1080], render__layers=list(layers)), gpu)
        pixel = view_ring.PIXEL_BYTES + view_ring.MASK_BYTES + size
        assert count * 1920 * 1080 * pixel <= view_ring.BATCH_BYTES < (count + 1) * 1920 * 1080 * pixel
    assert batch_of(settings(cameras__resolution=[8192, 8192]), gpu) == 1


def test_view_sizes_are_those_of_the_buffers(device):
    views = batch_of(config_of(), device)
    buffers = allocate(ViewBuffers, sizes_of(config_of(), device), device)
    assert buffers.color.shape == (views, 6, 8)
    assert buffers.pixels.shape == (views, ROOM, 3)
    # A word covers 32 rows, of which an image of six leaves most unused; a full-HD image leaves eight of 1088.
    assert buffers.mask_words.shape == (views, ROOM * 8)
    pixel = sum(wp.types.type_size_in_bytes(getattr(buffers, name).dtype) for name in ("color", "depth", "instance"))
    assert pixel == view_ring.PIXEL_BYTES


def test_main_lights_are_told_in_the_world_and_maps_without_any_as_zero(device):
    maps = (sun((1.0, 0.0, 1.0)), even_light())
    table = name_lights([light.name for light in maps], build_lights(maps, None, 1.0, device))
    assert table.name.tolist() == ["sun", "even"]
    assert not table.direction[1].any()
    # Counter-clockwise by a quarter, what stood over +x stands over +y: as far off as a texel of the map is wide.
    turned = table.directions(np.array([0, 0, 1]), np.array([0.0, np.pi / 2, 1.0]))
    np.testing.assert_allclose(turned, [[0.5**0.5, 0.0, 0.5**0.5], [0.0, 0.5**0.5, 0.5**0.5], [0.0, 0.0, 0.0]], atol=0.03)
    np.testing.assert_allclose(np.linalg.norm(turned[:2], axis=1), 1.0, rtol=1e-6)
    assert turned.dtype == np.float32


# ---- from the device ----


def new_record(device) -> TickRecord:
    config = config_of()
    sizes = worlds.world_sizes(config.bake.worlds, config.arrangement.max_objects, config.move.rounds, 4, 1)
    return TickRecord(*(allocate(kind, sizes, device) for kind in (Snapshot, worlds.WorldStatus, Observation, Plan)))


def test_a_report_has_every_array_under_its_name_and_outlives_the_next_tick(device):
    """Each is filled with a number of its own, and with another one afterwards."""
    record = new_record(device)
    parts = {"observation": record.observation, "plan": record.plan}
    given = {(part, name): 2 + number for part, arrays in parts.items() for number, name in enumerate(vars(arrays))}
    for (part, name), number in given.items():
        getattr(parts[part], name).fill_(number)
    record.snapshot.catalog_index.fill_(2)
    record.status.table.fill_(Phase.ACT)
    measures = np.arange(WORLDS)[:, None] + 10 * np.arange(len(Measure))
    record.status.measures.assign(measures.astype(np.float32))
    report = read_tick(record)
    everything = (record.snapshot.catalog_index, record.status.table, record.status.measures)
    for array in (*everything, *vars(record.observation).values(), *vars(record.plan).values()):
        array.fill_(99)
    record.snapshot.pose.fill_(wp.transform_identity())
    for (part, name), number in given.items():
        array = getattr(getattr(report, part), name)
        assert (array == number).all(), name
        assert len(array) == WORLDS
    assert (report.catalog_index == 2).all()
    assert report.column("phase").tolist() == [Phase.ACT] * WORLDS
    assert report.measure("peak_force").tolist() == [world + 10 * Measure.PEAK_FORCE for world in range(WORLDS)]
    assert (report.pose == 0.0).all()
    shapes = {"distances": (3,), "votes": (ROOM,)}
    assert {name: getattr(report.observation, name).shape for name in shapes} == {
        name: (WORLDS, ROOM, *rest) for name, rest in shapes.items()
    }
    assert (report.pose.shape, report.plan.point.shape) == ((WORLDS, ROOM, 7), (WORLDS, 3))
    assert (report.observation.grasp_pixel.dtype, report.observation.above.dtype) == (np.int32, np.uint32)


def test_a_host_copy_is_the_array_itself_on_the_cpu_and_a_copy_on_a_gpu(device):
    array = wp.array(np.arange(4.0), dtype=float, device=device)
    copy = HostCopy([array])
    copy.start(None)
    (seen,) = copy.wait()
    array.fill_(3.0)
    assert seen.tolist() == ([0.0, 1.0, 2.0, 3.0] if device.is_cuda else [3.0] * 4)


def test_run_boundaries_are_those_of_the_batchs_own_images(device):
    batches, _ = rendered(device, [1, 1, 0, 1, 1], 5)
    assert sum(made["length"] for made in batches) == 12
    for made in batches:
        for view in range(made["length"]):
            image, count = made["instance"][view], made["boundary_count"][view]
            boundaries = unpack_run_boundaries(made["boundaries"][view, :, :count], len(image))
            assert len(boundaries.place) == 2 * image.shape[1]
            for name, values in vars(find_run_boundaries(image)).items():
                np.testing.assert_array_equal(getattr(boundaries, name), values)


def test_files_and_lists_stand_for_images(device):
    """JPEG and depth files equal the encoded images; images that stay on the device are copied on demand, one at a time."""
    renderer, config = FakeRenderer([]), config_of(render__views_per_batch=4)
    host = view_ring.TransferSettings(("color", "depth", "instance", "mask_words"), 90, depth_files=True)
    frames = frame_stream(config, renderer, device, host)
    code = iter([11, 12, 13, 41, 42, 43])
    for batch in frames.render("snapshot", report_of([0, 1, 0, 0, 1])):  # type: ignore[arg-type]
        for view in range(len(batch)):
            value = next(code)
            for name, shape in (("color", (6, 8, 3)), ("depth", (6, 8)), ("instance", (6, 8)), ("mask_words", (ROOM * 8,))):
                image = getattr(batch, name)[view]
                assert image.shape == shape
                assert (image == value).all()
            # The quality is that of the effects, which this renderer sets to the view's code.
            assert batch.color_source(view).tobytes() == encode_jpeg(batch.color[view], value).tobytes()
            assert batch.depth_source(view).tobytes() == encode_depth(batch.depth[view])
    assert next(code, None) is None


@pytest.mark.parametrize(
    ("cuda", "needs_images", "settings_", "expected"),
    [
        (False, False, {}, view_ring.TransferSettings(depth_files=True)),
        (True, True, {}, view_ring.TransferSettings(("mask_words",), depth_files=True)),
        (True, True, {"cameras__resolution": [300, 287]}, view_ring.TransferSettings(depth_files=True)),
        (
            True,
            False,
            {"bop__split": "train_pbr", "bop__color_format": "jpg", "bop__jpeg_quality": 90},
            view_ring.TransferSettings(("depth", "color", "instance", "mask_words"), 90, True),
        ),
        (True, False, {"bop__color_format": "png"}, view_ring.TransferSettings(("depth", "instance", "mask_words"), depth_files=True)),
        (True, False, {"cameras__resolution": [300, 287]}, view_ring.TransferSettings(("depth",), depth_files=True)),
    ],
)
def test_what_is_copied_to_the_host(cuda, needs_images, settings_, expected):
    config = settings(**({"cameras__resolution": [640, 360]} | settings_))
    assert view_ring.choose_transfers(config.bop, config.rig.largest[1], SimpleNamespace(is_cuda=cuda), needs_images, True) == expected  # type: ignore[arg-type]


@pytest.mark.parametrize("objects", [1, 24, MAX_INSTANCES])
def test_the_largest_lists_are_no_larger_than_images(objects):
    one, columns = np.dtype(np.uint32).itemsize * FIELDS, 7
    sizes = boundary_sizes(view_buffer_sizes(1, columns, view_ring.MIN_LISTED_ROWS, objects))
    assert one * sizes["boundary"] <= view_ring.MIN_LISTED_ROWS * columns


def test_groups_of_cameras_take_turns_in_a_tick(device):
    """Cameras 0 and 2 have other images than camera 1: each batch has one size, and views know their camera among all."""
    config, renderer = config_of(render__views_per_batch=3), FakeRenderer([])
    rows = tuple(CameraRow(resolution=size, fov=20.0) for size in ((8, 6), (10, 4), (8, 6)))
    config = dataclasses.replace(config, camera=rows)
    rings = []
    for index, cameras in enumerate(config.rig.groups):
        sizes = view_sizes(config.render, config.rig, WORLDS, ROOM, device, index)
        rings.append(ViewRing(CameraGroup(cameras, sizes, renderer), (), device))  # type: ignore[arg-type]
    frames = FrameStream(rings, config.physics.tick_time, OBJECT_IDS, LIGHTS, device)
    ended, seen = [], []
    for tick in range(3):
        for batch in frames.advance("snapshot", report_of([1, 1, 0, 0, 1]), lambda tick=tick: ended.append(tick)):  # type: ignore[arg-type]
            assert len({rows[camera].resolution for camera in batch.camera.tolist()}) == 1
            assert batch.color.shape[1:3] == (rows[batch.camera[0]].resolution or ())[::-1]
            code = 10 * (batch.episode - 20) + batch.camera + 1
            assert (batch.color.reshape(len(batch), -1) == code[:, None]).all()
            seen += zip(batch.episode.tolist(), batch.camera.tolist(), strict=True)
    for batch in frames.drain():
        seen += zip(batch.episode.tolist(), batch.camera.tolist(), strict=True)
    assert ended == [0, 1, 2]
    assert sorted(seen) == sorted(3 * [(20 + world, camera) for world in (0, 1, 4) for camera in range(3)])


# ---- selections of ticks ----


EPISODES = (0, 2, 4, 6)


def test_a_selection_of_a_selection_has_the_rows_of_both():
    (batch,) = ticks(EPISODES, 1)
    chosen = batch.select(np.array([3, 1, 0])).select(np.array([2, 0]))
    assert chosen.episode.tolist() == [0, 6]
    np.testing.assert_array_equal(chosen.pose, batch.pose[[0, 3]])
    for own, whole in ((chosen.tick, batch.tick), (chosen.steps, batch.steps)):
        assert own.keys() == whole.keys()
        for name, values in whole.items():
            np.testing.assert_array_equal(own[name], values[[0, 3]], err_msg=name)


def test_a_selection_reads_rows_when_they_are_asked_for():
    arrays = {"speed": np.arange(4.0), "force": np.arange(4.0)}
    rows = SelectedRows(arrays, np.array([1, 3]))
    arrays["speed"] += 10.0
    assert (len(rows), rows["speed"].tolist()) == (2, [11.0, 13.0])
    rows["speed"][:] = 0.0
    assert rows["speed"].tolist() == [11.0, 13.0]


# ---- waiting for copies ----


class FakeEvent:
    """Stand-in for a CUDA event that is complete after a number of queries."""

    def __init__(self, queries: int) -> None:
        self.results = itertools.chain(itertools.repeat(False, queries), itertools.repeat(True))

    @property
    def is_complete(self) -> bool:
        return next(self.results)


def copy_after(queries: int) -> HostCopy:
    copy = HostCopy([wp.zeros(1, dtype=float, device="cpu")])
    copy.done = FakeEvent(queries)
    return copy


@pytest.mark.parametrize(("queries", "pauses"), [(0, 0), (3, 3)])
def test_a_wait_pauses_until_the_copy_is_done(monkeypatch, queries, pauses):
    synchronized, slept = [], []
    monkeypatch.setattr(wp, "synchronize_event", synchronized.append)
    monkeypatch.setattr(view_ring.time, "sleep", slept.append)
    monkeypatch.setattr(view_ring.time, "monotonic", lambda: 7.0)
    copy = copy_after(queries)
    assert copy.wait()[0].tolist() == [0.0]
    assert slept == [view_ring.PAUSE_SECONDS] * pauses
    assert synchronized == [copy.done]


def test_a_failed_copy_is_reported_though_its_event_is_never_complete(monkeypatch):
    def fail(_: FakeEvent) -> None:
        raise RuntimeError("Failed to synchronize event")

    monkeypatch.setattr(wp, "synchronize_event", fail)
    monkeypatch.setattr(view_ring, "MAX_PAUSED_SECONDS", 0.01)
    with pytest.raises(RuntimeError, match="Failed"):
        copy_after(10**9).wait()
