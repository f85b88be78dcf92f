"""Layers from settings to files: what a small bake leaves agrees with its own depth, masks and poses. Their PNG codec: values read back
equal those written, within the quantization steps that the notes state."""

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import synpick_warp
from synpick_warp.configs.schema import LAYERS
from synpick_warp.dataset.view import View, read_layer
from synpick_warp.dataset.view_files import SceneFolder
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.scene import write_layer
from synpick_warp.exporters.bop.view import write_rendered_layer
from synpick_warp.testing.exporters import digests
from synpick_warp.views.layer_codec import CODECS, decode_layer, encode_layer, layer_notes, layer_path
from synpick_warp.views.layers import LAYER_TABLE
from tests.builders import PICKING, STIRRING, bake_boxes, once

WIDTH, HEIGHT = 64, 36
TINY = STIRRING | {
    "bake.episodes": 3,
    "cameras.resolution": [WIDTH, HEIGHT],
    "cameras.positions": [[0, 0, 2], [0, -0.9, 1.8]],
    "cameras.ups": [[0, 1, 0], [0, 1, 0]],
    "bop.coco": False,
    "render.layers": list(LAYERS),
}
DEPTH_STEP = 1e-4
"""A count of the depth images [m]; half of it is their error."""


def baked(out: Path, given: Mapping[str, object] = TINY) -> Path:
    bake_boxes(out, given)
    return out / "train"


@pytest.fixture(scope="module")
def split(tmp_path_factory) -> Path:
    """One world takes all episodes, one after the other."""
    return once(tmp_path_factory, "layers", baked)[0] / "train"


CENTERS = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)


def surface(view: View) -> np.ndarray:
    """Points that the pixels show, in the camera's frame (H, W, 3) [m]."""
    rays = np.concatenate((CENTERS, np.ones((HEIGHT, WIDTH, 1))), axis=-1) @ np.linalg.inv(view.intrinsics).T
    return rays * view.depth[..., None]


def test_every_view_has_every_layer(split):
    scenes = sorted(split.iterdir())
    assert len(scenes) == 6
    for scene in scenes:
        assert {path.name for path in scene.iterdir() if path.is_dir()} == {"rgb", "depth", "mask", "mask_visib", *LAYERS}
        for name in LAYERS:
            assert [path.name for path in sorted((scene / name).iterdir())] == [path.name for path in sorted((scene / "rgb").iterdir())]
    notes = (split.parent / "dataset_info.md").read_text()
    assert all(f"- `{name}/`: " in notes for name in LAYERS)


def check_motion(view: View, before: View) -> float:
    """Points of an instance, carried by its poses of this image and the one before, must be where the layers say.

    Returns the largest flow [px].
    """
    flow, scene_flow, points = view.layer("flow"), view.layer("scene_flow"), surface(view)
    known, most = before.instance_ids.tolist(), 0.0
    for instance, seen, now in zip(view.instance_ids.tolist(), view.masks, view.object_to_camera, strict=True):
        then = before.object_to_camera[known.index(instance)]
        own = (points[seen] - now[:3, 3]) @ now[:3, :3]
        was = own @ then[:3, :3].T + then[:3, 3]
        # Half a step of the file, and what half a count of depth can turn and scale.
        np.testing.assert_allclose(scene_flow[seen], was - points[seen], atol=1e-5 + 0.5 * DEPTH_STEP)
        image = was @ view.intrinsics.T
        expected = image[:, :2] / image[:, 2:] - CENTERS[seen]
        np.testing.assert_allclose(flow[seen], expected, atol=1 / 128 + 0.005)
        most = max(most, float(np.abs(expected).max(initial=0.0)))
    return most


def unknown(view: View) -> np.ndarray:
    """Where there is a surface whose motion is unknown; both layers must agree."""
    found = np.isnan(view.layer("flow")[..., 0])
    np.testing.assert_array_equal(found, np.isnan(view.layer("scene_flow")[..., 0]))
    return found & (view.depth > 0)


def test_motion_is_that_of_the_poses(split):
    data, most = synpick_warp.open(split.parent), []
    for view in data.views():
        if view.frame == 0:
            assert np.isnan(view.layer("flow")).all()
            assert np.isnan(view.layer("scene_flow")).all()
            continue
        most.append(check_motion(view, data[view.episode].view(view.frame - 1, view.camera)))
        assert not unknown(view).any()
        # Table and tote stand.
        assert (view.layer("flow")[~view.masks.any(axis=0)] == 0.0).all(axis=-1).mean() > 0.5
    assert sum(value > 0.1 for value in most) >= 10
    assert max(most) > 5.0


def test_a_gripper_that_was_out_of_the_picture_has_no_motion(tmp_path):
    split = baked(tmp_path / "set", TINY | PICKING | {"bake.episodes": 1})
    chosen = {json.loads(line)["frame"] for line in (split.parent / "attempts.jsonl").read_text().splitlines()}
    data, appeared = synpick_warp.open(split.parent), 0
    for view in data.views():
        if view.frame == 0:
            continue
        check_motion(view, data[view.episode].view(view.frame - 1, view.camera))
        # Worlds choose without gripper; it comes in the next image.
        if view.frame - 1 in chosen:
            appeared += unknown(view).any()
            assert not unknown(view)[view.masks.any(axis=0)].any()
        else:
            assert not unknown(view).any()
    assert appeared


def test_classes_and_places_are_those_of_the_masks(split):
    data = synpick_warp.open(split.parent)
    for view in list(data.views())[::3]:
        classes, nocs, points = view.layer("classes"), view.layer("nocs"), surface(view)
        for object_id, seen, pose in zip(view.object_ids.tolist(), view.masks, view.object_to_camera, strict=True):
            assert (classes[seen] == object_id).all()
            low, size = (1e-3 * np.array([data.models_info[object_id][f"{end}_{axis}"] for axis in "xyz"]) for end in ("min", "size"))
            own = (points[seen] - pose[:3, 3]) @ pose[:3, :3]
            np.testing.assert_allclose(low + size / 2 + np.linalg.norm(size) * (nocs[seen] - 0.5), own, atol=DEPTH_STEP)
        rest = ~view.masks.any(axis=0)
        assert not classes[rest].any()
        assert not nocs[rest].any()


def test_normals_and_albedo_cover_what_there_is(split):
    for view in list(synpick_warp.open(split.parent).views())[::5]:
        normals, albedo, there = view.layer("normals"), view.layer("albedo"), view.depth > 0
        np.testing.assert_allclose(np.linalg.norm(normals[there], axis=-1), 1.0, atol=1e-4)
        assert (np.einsum("ij,ij->i", normals[there], surface(view)[there]) < 0.0).mean() > 0.99
        assert not normals[~there].any()
        # The boxes' material: 0.6, 0.5, 0.4.
        assert np.abs(albedo[view.masks.any(axis=0)].astype(int) - (153, 128, 102)).max(initial=0) <= 1


def test_worlds_writers_and_batches_change_no_layer(split, tmp_path):
    other = baked(tmp_path / "other", TINY | {"bake.worlds": 2, "bake.writers": 2, "render.views_per_batch": 3})
    assert digests(other) == digests(split)


def test_layers_change_nothing_else(split, tmp_path):
    few = digests(baked(tmp_path / "few", TINY | {"render.layers": ["flow"]}))
    whole = digests(split)
    assert few == {name: digest for name, digest in whole.items() if Path(name).parts[1] not in set(LAYERS) - {"flow"}}


# ---- files ----

SIDES = st.tuples(st.integers(1, 6), st.integers(1, 6))


def motion_layers(channels: int, low: float, high: float):
    """Strategy for float32 layers (H, W, channels) whose pixels are all finite or all NaN."""
    numbers = st.floats(low, high, width=32)
    shape = SIDES.map(lambda sides: (*sides, channels))
    return st.tuples(shape.flatmap(lambda s: hnp.arrays(np.float32, s, elements=numbers)), st.integers(0, 2**32 - 1)).map(_insert_holes)


def _insert_holes(drawn: tuple[np.ndarray, int]) -> np.ndarray:
    values, bits = drawn
    holes = (bits >> (np.arange(values[..., 0].size) % 32)) & 1
    return np.where(holes.reshape(values.shape[:2])[..., None] == 1, np.float32(np.nan), values)


def test_every_layer_has_a_codec_and_a_note():
    assert {layer.encoding for layer in LAYER_TABLE.values()} == set(CODECS)
    notes = layer_notes(LAYERS)
    assert [line.split("`")[1] for line in notes.splitlines()] == [f"{name}/" for name in LAYERS]
    assert layer_notes(("flow", "nocs")).count("\n") == 2
    assert layer_notes(()) == ""


@given(motion_layers(2, -511.0, 511.0), motion_layers(3, -0.625, 0.625))
def test_flow_round_trips_to_a_128th_of_a_pixel_and_scene_flow_to_a_hundredth_of_a_millimetre(flow, scene_flow):
    for name, values, step in (("flow", flow, 1 / 128 + 1e-6), ("scene_flow", scene_flow, 1e-5 + 1e-7)):
        back = decode_layer(name, encode_layer(name, values))
        assert back.dtype == np.float32
        np.testing.assert_allclose(back, values, atol=step)


@given(hnp.arrays(np.float32, SIDES.map(lambda sides: (*sides, 3)), elements=st.floats(-1.0, 1.0, width=32)))
def test_normals_and_nocs_round_trip_to_half_a_step(values):
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    normals = np.where(length > 0.1, values / np.maximum(length, 1e-9), np.float32(0.0))
    np.testing.assert_allclose(decode_layer("normals", encode_layer("normals", normals)), normals, atol=0.51 / 32767)
    nocs = np.abs(values)
    np.testing.assert_allclose(decode_layer("nocs", encode_layer("nocs", nocs)), nocs, atol=0.51 / 65535)


def test_flow_image_follows_the_kitti_format():
    """KITTI's development kit: u = (I_1 - 2^15) / 64, v = (I_2 - 2^15) / 64, known where I_3."""
    image = encode_layer("flow", np.array([[(1.5, -2.0), (0.0, 0.0), (np.nan, np.nan)]], np.float32))
    assert image.dtype == np.uint16
    assert image.tolist() == [[[32768 + 96, 32768 - 128, 1], [32768, 32768, 1], [0, 0, 0]]]


def test_motion_out_of_range_is_unknown_instead_of_clipped():
    flow = np.array([[(511.98, -512.0), (512.0, 0.0), (0.0, -512.1), (np.inf, 0.0)]], np.float32)
    np.testing.assert_array_equal(np.isfinite(decode_layer("flow", encode_layer("flow", flow))).all(axis=-1), [[True, False, False, False]])
    scene_flow = np.array([[(0.655, -0.655, 0.0), (0.0, 0.0, 0.656), (-0.656, 0.0, 0.0)]], np.float32)
    back = decode_layer("scene_flow", encode_layer("scene_flow", scene_flow))
    np.testing.assert_array_equal(np.isfinite(back).all(axis=-1), [[True, False, False]])


def test_code_of_no_surface_differs_from_every_normal():
    normals = np.array([[(0, 0, -1), (-1, 0, 0), (0, 0, 0)]], np.float32)
    assert encode_layer("normals", normals).tolist() == [[[32768, 32768, 1], [1, 32768, 32768], [0, 0, 0]]]
    np.testing.assert_array_equal(decode_layer("normals", encode_layer("normals", normals)), normals)


VALUES = {
    "normals": np.array([[(0, 0.6, -0.8)] * 3, [(0, 0, 0)] * 3], np.float32),
    "albedo": np.arange(18, dtype=np.uint8).reshape(2, 3, 3),
    "nocs": np.linspace(0, 1, 18, dtype=np.float32).reshape(2, 3, 3),
    "classes": np.array([[0, 1, 21], [65535, 300, 0]], np.uint16),
    "flow": np.array([[(1.25, -3.5)] * 3, [(np.nan, np.nan)] * 3], np.float32),
    "scene_flow": np.array([[(0.002, -0.1, 0.05)] * 3, [(np.nan, np.nan, np.nan)] * 3], np.float32),
}
VALUES |= dict.fromkeys(("depth_sensor", "depth_stereo"), np.array([[0, 18000, 65535], [1, 17999, 18001]], np.uint16))
VALUES |= dict.fromkeys(("ir_left", "ir_right"), np.array([[0, 128, 255], [1, 127, 254]], np.uint8))
VALUES |= dict.fromkeys(("suction_seal", "suction_wrench"), np.array([[0, 0.5, 1], [0.25, 0, 0.125]], np.float32))


@pytest.mark.parametrize("name", LAYERS)
def test_layer_files_round_trip(tmp_path, name):
    (tmp_path / name).mkdir()
    write_rendered_layer(VALUES[name], write_layer, tmp_path, 0, name, 12)
    assert layer_path(tmp_path, name, 12) == tmp_path / name / "000012.png"
    back = read_layer(SceneFolder(tmp_path, VALUES[name].shape[1::-1]), name, 12)
    assert (back.shape, back.dtype) == (VALUES[name].shape, VALUES[name].dtype)
    assert (back.dtype.name, back.shape[2:] or (1,)) == (LAYER_TABLE[name].dtype, (LAYER_TABLE[name].components,))
    np.testing.assert_allclose(back, VALUES[name], atol=2e-5)


def test_missing_and_invalid_files_are_reported(tmp_path):
    with pytest.raises(DatasetError, match=r"there is no layer depth; layers: normals, "):
        read_layer(SceneFolder(tmp_path), "depth", 0)
    with pytest.raises(DatasetError, match=r"has no layer flow; it has none; bake with render\.layers"):
        read_layer(SceneFolder(tmp_path), "flow", 3)
    (tmp_path / "flow").mkdir()
    path = tmp_path / "flow" / "000003.png"
    grey = cv2.imencode(".png", np.zeros((4, 4), np.uint16))[1].tobytes()
    eight = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    for content in (b"", b"no picture", grey, eight):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=r"flow/000003\.png is not an image|flow of image 3 in .*; expected: 3 of type uint16"):
            read_layer(SceneFolder(tmp_path, (4, 4)), "flow", 3)
