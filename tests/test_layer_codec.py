"""PNG codec of annotation layers: values read back equal those written, within the quantization steps that the notes state."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from synpick_warp.configs.schema import LAYERS
from synpick_warp.dataset.view import read_layer
from synpick_warp.dataset.view_files import SceneFolder
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.scene import write_layer
from synpick_warp.exporters.bop.view import write_rendered_layer
from synpick_warp.views.layer_codec import CODECS, decode_layer, encode_layer, layer_notes, layer_path
from synpick_warp.views.layers import LAYER_TABLE

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
