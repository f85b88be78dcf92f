"""Online generator: the views of a bake in memory, whatever is chosen of them; and nothing is left of a stream that was left."""

import contextlib
import gc
import subprocess
import sys
import weakref
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import synpick_warp
from synpick_warp.configs.schema import LAYERS
from synpick_warp.errors import ConfigError
from synpick_warp.factory import assembly
from synpick_warp.online import stream as online
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReader
from synpick_warp.views.layer_codec import decode_layer, encode_layer
from tests.builders import COARSE
from tests.harness.environment import checkout_environment
from tests.online.conftest import LAYERED, tiny
from tests.worlds.cells import CELL, make_camera
from tests.worlds.small_worlds import QUICK, settings

View = dict[str, np.ndarray]
SCRIPT = """
import synpick_warp
for batch in synpick_warp.stream("smoke", {settings!r}, resolution=(32, 18)):
    print(len(batch), batch.color.shape)
    break
"""


def taken(stream) -> dict[tuple[int, int, int], View]:
    """Copies of all views, by episode, camera and frame."""
    views = {}
    for batch in stream:
        arrays = {name: value.numpy().copy() for name, value in vars(batch).items() if hasattr(value, "__dlpack__")}
        arrays |= {"visible_masks": batch.visible_masks().numpy().copy(), "amodal_masks": batch.amodal_masks().numpy().copy()}
        arrays |= {name: value.numpy().copy() for name, value in batch.layers.items()}
        for view in range(len(batch)):
            row = {name: values[view] for name, values in arrays.items()}
            row["mask_words"] = row["mask_words"][: row["mask_length"]]  # What follows is of no meaning.
            row |= {f"host_{name}": values[view] for name, values in batch.host.items()}
            views[int(row["episode"]), int(row["camera"]), int(row["frame"])] = row
    return views


@pytest.fixture(scope="module")
def streamed() -> tuple[dict[tuple[int, int, int], View], online.ViewStream]:
    stream = synpick_warp.stream(settings(**LAYERED))
    refs = held_by(stream)
    views = taken(stream)
    assert next(stream, None) is None
    assert [ref() for ref in refs[:2]] == [None] * 2  # An exhausted stream holds nothing, either.
    return views, stream


def equal(one: dict[tuple[int, int, int], View], other: dict[tuple[int, int, int], View]) -> None:
    assert one.keys() == other.keys()
    for key, view in one.items():
        assert view.keys() == other[key].keys()
        for name, values in view.items():
            np.testing.assert_array_equal(values, other[key][name], err_msg=name)


# ---- the same content as a bake ----


def test_views_are_those_that_a_bake_writes(streamed, tmp_path):
    views, stream = streamed
    summary = synpick_warp.bake(settings(**LAYERED | {"bake.worlds": 1}), tmp_path / "set")
    assert (stream.summary.episodes, stream.summary.views) == (summary.episodes, summary.views)
    data = synpick_warp.open(tmp_path / "set")
    expected = {(index, camera, frame) for index in data for camera in range(3) for frame in range(len(data[index]))}
    assert views.keys() == expected
    for (episode, camera, frame), made in views.items():
        view = data[episode].view(frame, camera)
        np.testing.assert_array_equal(made["color"], view.rgb)
        np.testing.assert_array_equal(made["depth"] * np.float32(stream.config.bop.depth_scale / 1000), view.depth)
        for name in LAYERS:
            np.testing.assert_array_equal(decode_layer(name, encode_layer(name, made[name])), view.layer(name), err_msg=name)
        present = made["object_id"] >= 0
        np.testing.assert_array_equal(np.flatnonzero(present), view.instance_ids)
        np.testing.assert_array_equal(made["object_id"][present], view.object_ids)
        np.testing.assert_array_equal(made["visible_masks"][present], view.masks)
        np.testing.assert_array_equal(made["amodal_masks"][present], view.amodal_masks)
        assert not made["amodal_masks"][~present].any()
        for row, count in zip(view.records.gt_info, made["pixels"][present].tolist(), strict=True):
            assert [row[f"px_count_{name}"] for name in ("all", "valid", "visib")] == count
        seen = made["pixels"][present, 2] > 0
        for written, box in ((view.boxes, made["boxes"][present, 0]), (view.visible_boxes, made["boxes"][present, 1])):
            np.testing.assert_array_equal(written[seen], np.concatenate((box[:, :2], box[:, 2:] - box[:, :2]), axis=1)[seen])
        np.testing.assert_allclose(made["object_to_camera"][present], view.object_to_camera, rtol=0, atol=1e-6)
        np.testing.assert_allclose(made["world_to_camera"], view.world_to_camera, rtol=0, atol=1e-6)
        np.testing.assert_allclose(made["intrinsics"], view.intrinsics, rtol=1e-6)
        light = view.records.camera["light"]
        assert (made["host_light_name"], round(float(made["host_light_yaw"]), 6)) == (light["map"], light["yaw"])


def test_what_the_host_knows_is_what_the_device_has(streamed):
    for (episode, camera, frame), view in streamed[0].items():
        assert (view["host_episode"], view["host_camera"], view["host_frame"]) == (episode, camera, frame)
        assert view["host_arrangement"] == 0
        np.testing.assert_array_equal(view["object_id"], view["host_object_id"])
        present = view["object_id"] >= 0
        np.testing.assert_array_equal(view["pose"][present], view["host_pose"][present])
        np.testing.assert_array_equal(view["pose"][~present], np.tile([0, 0, 0, 0, 0, 0, 1], (int((~present).sum()), 1)))


@pytest.mark.parametrize(("worlds", "batch"), [(1, 2), (4, 5)])
def test_neither_worlds_nor_batches_change_a_view(streamed, worlds, batch):
    with synpick_warp.stream(settings(**LAYERED), worlds=worlds, batch=batch) as stream:
        equal(taken(stream), streamed[0])


def test_kernels_that_are_compiled_ahead_change_nothing(streamed, monkeypatch):
    monkeypatch.setattr(assembly, "is_cache_warm", lambda device: False)
    equal(taken(synpick_warp.stream(settings(**LAYERED))), streamed[0])


def test_what_is_left_out_changes_nothing_in_the_rest(streamed):
    """Light accumulates from frame to frame; where frames are left out, each is rendered as without a history."""
    some = taken(synpick_warp.stream(settings(**LAYERED), cameras=(2, 0), stride=3, episodes=range(1, 9), shard=(1, 8)))
    accumulated, alone = streamed[0], taken(synpick_warp.stream(settings(**LAYERED | {"render.history": 0}), episodes=range(1, 2)))
    expected = {key: dict(view) for key, view in accumulated.items() if key[0] == 1 and key[1] != 1 and key[2] % 3 == 0}
    for key, view in expected.items():
        view["color"] = alone[key]["color"]
    equal(some, expected)


# ---- settings ----


def test_settings_come_from_presets_files_and_arguments(tmp_path):
    (tmp_path / "my.toml").write_text('preset = "smoke"\n[bake]\nworlds = 3\nseed = 7\n')
    names = ("bake.seed", "bake.worlds", "bake.device", "cameras.resolution")
    given = dict(QUICK) | {"bake.worlds": 5}
    for config in (tmp_path / "my.toml", synpick_warp.load_config(tmp_path / "my.toml")):
        stream = synpick_warp.stream(config, given, worlds=2, device="cpu", resolution=(32, 18), layers=("normals",), batch=4)
        found = [getattr(getattr(stream.config, key.partition(".")[0]), key.partition(".")[2]) for key in names]
        assert found == [7, 2, "cpu", (32, 18)]
        assert (stream.config.render.layers, stream.config.render.views_per_batch) == (("normals",), 4)
        assert [camera.width for camera in stream.cameras] == [32] * 3
        assert stream.object_names[1] == "boxes_1"
        stream.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"settings": {"bake.world": 3}}, r"did you mean worlds"),
        ({"worlds": -1}, r"bake\.worlds is -1 .*at least 0"),
        ({"device": "cuda:99"}, r"cuda:99 was requested"),
        ({"resolution": (31, -1)}, r"cameras\.resolution"),
        ({"cameras": (3,)}, r"cameras are \[3\]; allowed: one or more of 0 to 2"),
        ({"stride": 0}, r"stride is 0"),
        ({"episodes": range(-2, 4)}, r"episodes are range\(-2, 4\)"),
        ({"episodes": 0}, r"episodes are 0"),
        ({"episodes": 10**12}, r"episodes are 1000000000000; allowed: how many, or a range of indices from 0 to 2147483646"),
        ({"episodes": range(2**31 - 2, 0, -1)}, r"the lists of 2,147,483,646 episodes take at least 200\.0 GiB"),
        ({"stride": 1.5}, r"stride is 1\.5; allowed: a whole number"),
        ({"cameras": 0}, r"cameras are 0; allowed"),
        ({"cameras": [[0]]}, r"cameras are \[\[0\]\]; allowed"),
        ({"splits": 5}, r"splits are 5; allowed: a list of names"),
        ({"stride": True}, r"stride is True"),
        ({"shard": "0/2"}, r"shard is '0/2'; allowed: \(i, n\)"),
        ({"shard": (0, 1, 2)}, r"shard is \(0, 1, 2\)"),
        ({"splits": "train"}, r"splits are .train.; allowed: a list of names"),
        ({"shard": (2, 2)}, r"shard is 2/2"),
        ({"shard": (5, 8)}, r"shard 5/8 has no episode"),
        ({"splits": ("train",)}, r"there is no split"),
        ({"batch": -1}, r"render\.views_per_batch"),
    ],
)
def test_a_mistake_is_one_line(arguments, message):
    with pytest.raises(synpick_warp.SynpickError, match=message) as raised:
        synpick_warp.stream(tiny(), **arguments)
    assert "\n" not in str(raised.value)


def test_splits_name_their_episodes():
    config = synpick_warp.load_config("synpick", splits=True)
    with pytest.raises(ConfigError, match="beside splits"):
        synpick_warp.stream(config, device="cpu", episodes=3)
    with pytest.raises(ConfigError, match=r"bake\.mode is set .* has its splits already"):
        synpick_warp.stream(config, device="cpu", mode="move")


# ---- an end at any time ----


def held_by(stream) -> tuple[weakref.ref, ...]:
    """Weak references to the parts of a stream that hold memory: worlds, their collision pipeline and model, renderer, ring."""
    producer = stream._batches.gi_frame.f_locals["producer"]
    simulation = producer.stages.simulation
    renderer, ring = producer.stages.groups[0].renderer, producer.rings[0]
    parts = (producer, ring, simulation, simulation.physics.pipeline, simulation.physics.model, renderer)
    return tuple(weakref.ref(part) for part in parts)


@pytest.fixture
def collects_nothing() -> Iterator[None]:
    """What is freed is freed by its last reference."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.parametrize("end", ["break", "error", "close", "before the first"])
def test_nothing_is_left_of_a_stream(collects_nothing, end):
    assert [ref() for ref in leave(end)] == [None] * 6


def test_worlds_are_freed_where_a_traceback_holds_the_frames(collects_nothing, monkeypatch):
    """As Warp's code generation leaves them: exceptions in cycles with the frames that caught them, whose callers are the tick loop."""
    tick_parts = Simulation.tick_parts

    def compile_and_tick(simulation: Simulation) -> Iterator[None]:
        try:
            raise KeyError("a name to be looked up elsewhere")
        except KeyError as error:
            kept = error  # noqa: F841  # The error's traceback holds this frame, whose variable holds the error.
        return tick_parts(simulation)

    monkeypatch.setattr(Simulation, "tick_parts", compile_and_tick)
    assert [ref() for ref in leave("break")] == [None] * 6


def leave(end: str) -> tuple[weakref.ref, ...]:
    """Open a stream and leave it; references to what it held."""
    stream = synpick_warp.stream(tiny(bake__episodes=1), worlds=1)
    refs = held_by(stream)
    if end == "before the first":
        return refs
    with contextlib.suppress(ZeroDivisionError):
        for batch in stream:
            if end == "error":
                raise ZeroDivisionError
            if end == "break":
                break
            stream.close()
            with pytest.raises(BufferError, match="expired"):
                np.from_dlpack(batch.color)
            assert next(stream, None) is None
    return refs


def test_a_batch_refuses_use_after_its_time():
    with synpick_warp.stream(tiny(bake__episodes=1), worlds=1) as stream:
        first = next(stream)
        colour = wp.from_dlpack(first.color)
        assert colour.ptr == wp.from_dlpack(first.color).ptr
        copied, before = wp.from_dlpack(first.color.__dlpack__(copy=True)), first.color.numpy().copy()
        assert copied.ptr != colour.ptr
        with pytest.raises(BufferError, match="move it"):
            first.color.__dlpack__(dl_device=(99, 0))
        next(stream)
        assert (copied.numpy() == before).all()
        for use in (lambda: wp.from_dlpack(first.color), first.depth.numpy, first.visible_masks):
            with pytest.raises(BufferError, match="clone what you keep"):
                use()
        assert first.host["frame"].tolist() == [0, 0, 0]
    assert colour.numpy().shape == (3, 36, 64, 3)  # What was imported keeps its memory.


def test_a_failure_while_a_batch_is_made_ends_the_stream(monkeypatch):
    stream = synpick_warp.stream(tiny(bake__episodes=1), worlds=1)
    next(stream)

    def fail(*_: object) -> None:
        raise RuntimeError("Failed to allocate 1 bytes on device 'cpu'")

    monkeypatch.setattr(TickReader, "wait", fail)
    with pytest.raises(ConfigError, match="ran out of memory"):
        for _ in stream:
            pass
    assert next(stream, None) is None


@pytest.mark.slow
def test_a_script_needs_no_main_guard(tmp_path):
    """It leaves the loop early, and the process ends by itself, without children."""
    script = tmp_path / "train.py"
    script.write_text(
        SCRIPT.format(settings=QUICK | COARSE | {"bake.device": "cpu"})
        + "import os\nos.execvp('ps', ['ps', '--ppid', str(os.getpid()), '--no-headers'])"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, cwd=tmp_path, env=checkout_environment(), timeout=300)
    assert done.stdout == "3 (3, 18, 32, 3)\n"
    (note,) = done.stderr.splitlines()  # Logged, as nobody observes.
    assert note.startswith("never drawn, since larger than arrangement.volume")
    assert done.returncode == 1  # ps found no children.


# ---- [[camera]] tables: two image sizes, drawn and carried cameras ----

CAMERAS = (*CELL, make_camera("small", resolution=[64, 48], fov=40.0))
SIZES = [(96, 72)] * 3 + [(64, 48)]


def test_views_of_two_sizes_are_those_that_a_bake_writes(tmp_path):
    config = replace(tiny(bake__episodes=1, bake__worlds=1, render__layers=["flow"]), camera=CAMERAS)
    synpick_warp.bake(config, tmp_path / "set")
    data, stream = synpick_warp.open(tmp_path / "set"), synpick_warp.stream(config)
    views = taken(stream)
    assert views.keys() == {(0, camera, frame) for camera in range(len(SIZES)) for frame in range(len(data[0]))}
    for (episode, camera, frame), made in views.items():
        view = data[episode].view(frame, camera)
        assert made["color"].shape == (*SIZES[camera][::-1], 3)
        np.testing.assert_array_equal(made["color"], view.rgb)
        np.testing.assert_array_equal(made["depth"] * np.float32(config.bop.depth_scale / 1000), view.depth)
        np.testing.assert_allclose(made["intrinsics"], view.intrinsics, rtol=1e-6)
        np.testing.assert_allclose(made["world_to_camera"], view.world_to_camera, rtol=0, atol=1e-6)
        present = made["object_id"] >= 0
        np.testing.assert_allclose(made["object_to_camera"][present], view.object_to_camera, rtol=0, atol=1e-6)
        if camera in (0, 2):
            np.testing.assert_allclose(made["host_matrix"], view.intrinsics, rtol=0, atol=1e-12)
            np.testing.assert_allclose(made["host_translation"], view.world_to_camera[:3, 3], rtol=0, atol=1e-12)


def test_a_choice_of_cameras_gives_those_alone():
    config = replace(tiny(bake__episodes=1, bake__worlds=1), camera=CAMERAS)
    views = taken(synpick_warp.stream(config, cameras=[3, 0], stride=2))
    assert {camera for _, camera, _ in views} == {0, 3}
    assert {frame % 2 for *_, frame in views} == {0}
