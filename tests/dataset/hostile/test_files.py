"""Hostile images, annotations and shards of a data set: each is a DatasetError of one line, before memory is filled."""

from __future__ import annotations

import io
import json
import os
import struct
import tarfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import synpick_warp
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset import view_files
from synpick_warp.dataset.annotations import MASK_SCHEMA, VIEW_SCHEMAS, Key, ModelInfo, check_json, read_checked
from synpick_warp.dataset.commit.manifest import CONFIG_FILE, ENTRIES, MANIFEST_FILE
from synpick_warp.dataset.view_files import SceneShards
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.system.inputs.image_files import decode_image, image_size
from synpick_warp.system.inputs.tar_files import list_members
from tests.harness.exporter_contract import LENSES, export
from tests.harness.fuzz import fuzz_examples
from tests.harness.hostile import places, replaced
from tests.worlds.box_views import config

SIZE, FRAMES = (LENSES[0].width, LENSES[0].height), 2


def open_set(folder: Path, exporter: type) -> synpick_warp.DataSet:
    """A data set of one episode of boxes."""
    given_settings = config(("flow",), split="train", color_format="png")
    export(exporter, folder, given_settings, (0,), 0, FRAMES)
    (folder / CONFIG_FILE).write_text(config_to_toml(given_settings))
    (folder / MANIFEST_FILE).write_text("{}")
    (folder / ENTRIES).mkdir()
    (folder / ENTRIES / "000000.json").write_text(json.dumps({"row": {"frames": FRAMES, "ending": "finished"}, "attempts": []}))
    return synpick_warp.open(folder)


# ---- images ----


def bomb(width: int, height: int) -> bytes:
    """A PNG that states a size and has hardly any data."""
    parts = (b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0), b"IDAT" + zlib.compress(bytes(100)), b"IEND")
    chunks = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "is not an image: neither PNG nor JPEG"),
        (b"II*\x00" + bytes(100), "is not an image: neither PNG nor JPEG"),
        (bomb(100_000, 100_000), "F has 100000 x 100000 pixels; allowed: up to 8192 x 8192"),
        (bomb(0, 5), "F has 0 x 5 pixels"),
        (bomb(2**31 + 1, 1), "F has 2147483649 x 1 pixels"),
        (cv2.imencode(".jpg", np.zeros((7, 11)))[1].tobytes().replace(b"\0\7\0\13", b"\xff" * 4), "F has 65535 x 65535 pixels"),
        (b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xff\xff\xff\x03", "is not an image"),
        (b"\xff\xd8" + b"\xff\xe0\x00\x02" * 10_000, "is not an image"),
        (b"\xff\xd8" + b"\xff" * 100_000, "is not an image"),
        (b"\x89PNG\r\n\x1a\n", "is not an image"),
    ],
)
def test_the_size_of_an_image_is_checked_before_it_is_decoded(data, said):
    with pytest.raises(DatasetError, match=said):
        decode_image(data, "F", DatasetError)


def test_sizes_of_png_and_jpeg_are_those_of_the_pixels():
    image = np.zeros((7, 11, 3), np.uint8)
    for suffix in (".png", ".jpg"):
        data = cv2.imencode(suffix, image)[1].tobytes()
        assert image_size(data) == (11, 7)
        np.testing.assert_array_equal(decode_image(data, "F", DatasetError, size=(11, 7)), image)
        with pytest.raises(DatasetError, match="F has 11 x 7 pixels; the images of this camera have 7 x 11"):
            decode_image(data, "F", DatasetError, size=(7, 11))


@settings(max_examples=fuzz_examples(200), deadline=None)
@given(st.data())
def test_a_changed_image_is_decoded_or_named(data):
    image = np.arange(5 * 9 * 3, dtype=np.uint8).reshape(5, 9, 3)
    content = bytearray(cv2.imencode(data.draw(st.sampled_from([".png", ".jpg"])), image)[1].tobytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, min(60, len(content) - 1)))] = data.draw(st.integers(0, 255))
    try:
        assert max(decode_image(bytes(content), "F", DatasetError).shape) <= 8192
    except DatasetError as error:
        message = str(error)
    else:
        message = "F"
    assert message.startswith("F")
    assert message.isprintable()


def encoded(*shape: int, dtype: type = np.uint8) -> bytes:
    return cv2.imencode(".png", np.zeros(shape, dtype))[1].tobytes()


@pytest.mark.parametrize(
    ("name", "content", "part", "said"),
    [
        ("rgb/000000.png", encoded(4, 4, 3), "rgb", "rgb/000000.png has 4 x 4 pixels; the images of this camera have"),
        ("rgb/000000.png", encoded(*SIZE[::-1]), "rgb", "rgb of image 0 in .* has 1 channels of type uint8; expected: 3 of type uint8"),
        ("depth/000000.png", encoded(*SIZE[::-1], 3, dtype=np.uint16), "depth", "depth of image 0 in .* has 3 channels"),
        ("depth/000000.png", encoded(*SIZE[::-1]), "depth", "of type uint8; expected: 1 of type uint16"),
        ("mask/000000_000001.png", encoded(9, 9), "amodal_masks", "mask/000000_000001.png has 9 x 9 pixels"),
        ("mask_visib/000000_000000.png", encoded(*SIZE[::-1], 3), "masks", "mask_visib/000000_000000.png has 3 channels"),
        ("flow/000000.png", encoded(*SIZE[::-1]), "flow", "flow of image 0 in .* has 1 channels"),
    ],
)
def test_an_image_that_does_not_fit_its_camera_is_named(tmp_path, name, content, part, said):
    data = open_set(tmp_path / "set", BopExporter)
    (data.folder / "train" / "000000" / name).write_bytes(content)
    view = data[0].view(0)
    with pytest.raises(DatasetError, match=said):
        _ = view.layer(part) if part == "flow" else getattr(view, part)


def test_a_pipe_in_place_of_an_image_does_not_hang(tmp_path):
    data = open_set(tmp_path / "set", BopExporter)
    path = data.folder / "train" / "000000" / "rgb" / "000000.png"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DatasetError, match=r"000000\.png is not a regular file"):
        _ = data[0].view(0).rgb


# ---- annotations ----


@pytest.mark.parametrize(
    ("name", "place", "value", "said"),
    [
        ("camera", (0, "cam_K"), [1.0] * 8, r"scene_camera\.json is damaged: expected array of length >= 9 - at \$\[\.\.\.\]\.cam_K"),
        ("camera", (0, "depth_scale"), "0.1", r"expected float, got str"),
        ("camera", (0, "cam_R_w2c"), [0.0] * 9, r"the camera of image 0 has a cam_R_w2c that is no rotation"),
        ("gt", (0, 0, "cam_t_m2c"), [0.0, 0.0, 10**30], r"expected float <= 1000000000"),
        ("gt", (0, 0), 3, r"expected object, got int"),
        ("gt", (0, 0, "obj_id"), -1, r"expected int >= 0"),
        ("gt", (0,), [], r"do not agree about image 0"),
        ("gt_info", (0, 0, "bbox_visib"), [1, 2, 3], r"of length >= 4"),
        ("gt_info", (0, 0, "px_count_all"), -5, r"expected int >= 0"),
    ],
)
def test_a_wrong_annotation_is_named_with_file_and_place(tmp_path, name, place, value, said):
    data = open_set(tmp_path / "set", BopExporter)
    path = data.folder / "train" / "000000" / f"scene_{name}.json"
    path.write_text(json.dumps(replaced(json.loads(path.read_text()), (str(place[0]), *place[1:]), value)))
    view = data[0].view(0)
    with pytest.raises(DatasetError, match=said) as caught:
        _ = view.boxes, view.object_to_world
    assert str(caught.value).isprintable()


def test_annotations_of_a_scene_are_checked_once(tmp_path, monkeypatch):
    episode = open_set(tmp_path / "set", BopExporter)[0]
    read: list[Path] = []
    monkeypatch.setattr(view_files, "read_checked", lambda path, schema: read.append(path) or read_checked(path, schema))
    for frame in (0, 1, 0):
        assert len(episode.view(frame)) > 0
    assert len(read) == 3


DOCUMENTS = {
    "camera": {"0": {"cam_K": [1.0] * 9, "depth_scale": 0.1, "cam_R_w2c": [0.0] * 9, "cam_t_w2c": [0.0] * 3, "light": {"map": "x"}}},
    "gt": {"0": [{"cam_R_m2c": [0.0] * 9, "cam_t_m2c": [0.0] * 3, "obj_id": 1, "instance_id": 0}]},
    "gt_info": {
        "0": [{"bbox_obj": [1] * 4, "bbox_visib": [1] * 4, "px_count_all": 1, "px_count_valid": 1, "px_count_visib": 1, "visib_fract": 1.0}]
    },
}
SCHEMAS = {name: dict[Key, schema] for name, schema in VIEW_SCHEMAS.items()} | {"mask": MASK_SCHEMA, "models": dict[int, ModelInfo]}
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3) | st.sampled_from(["0", "counts", "size"]), inner, max_size=3)
    ),
    max_leaves=12,
)


@settings(max_examples=fuzz_examples(200), deadline=None)
@given(st.sampled_from(sorted(DOCUMENTS)), st.integers(0, 10**6), JSON)
def test_changed_annotations_are_of_the_schema_or_named(name, spot, value):
    where = list(places(DOCUMENTS[name]))
    content = json.dumps(replaced(DOCUMENTS[name], where[spot % len(where)], value)).encode()
    try:
        [entry] = check_json(content, SCHEMAS[name], "F").values() or [None]
    except DatasetError as error:
        assert str(error).startswith("F is damaged: ")  # noqa: PT017
        assert str(error).isprintable()  # noqa: PT017
        return
    except ValueError:
        assert value == {}
        return
    for record in [entry] if name == "camera" else entry:
        lists = {"cam_K": 9, "cam_R_m2c": 9, "cam_t_m2c": 3, "bbox_obj": 4, "bbox_visib": 4}
        assert all(len(record[key]) == length and np.isfinite(record[key]).all() for key, length in lists.items() if key in record)


# ---- shards ----


def tar(*members: tuple[tarfile.TarInfo, bytes], form: int = tarfile.USTAR_FORMAT) -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=form) as archive:
        for info, data in members:
            archive.addfile(info, io.BytesIO(data))
    return file.getvalue()


def member(name: str, size: int = 0, **fields: object) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.size = size
    for key, value in fields.items():
        setattr(info, key, value)
    return info


def lying(size: int) -> bytes:
    """A member that states a size, without data."""
    return member("000000_000000.gt.json", size).tobuf(tarfile.GNU_FORMAT)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (tar((member("a", type=tarfile.SYMTYPE, linkname="/etc/passwd"), b"")), "has a member at byte 0 that is not a regular file"),
        (tar((member("a", type=tarfile.LNKTYPE, linkname="b"), b"")), "not a regular file"),
        (tar((member("a", type=tarfile.CHRTYPE), b"")), "not a regular file"),
        (tar((member("a", type=tarfile.GNUTYPE_SPARSE), b"")), "not a regular file"),
        (tar((member("ü" * 200), b""), form=tarfile.PAX_FORMAT), "not a regular file"),
        (lying(2**60), "the member at byte 0 has 1073741824 GiB"),
        (lying(10), "the member at byte 0 has 10 bytes"),
        (lying(10)[:300], "truncated header"),
        (b"x" * 512, "is damaged: "),
        (tar((member("a", 5), b"12345"))[:514], "the member at byte 0 has 5 bytes"),
    ],
)
def test_a_hostile_shard_is_named(tmp_path, content, said):
    path = tmp_path / "shard-000000.tar"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=said) as caught:
        list_members(path)
    assert str(caught.value).isprintable()


def test_members_are_those_of_tarfile(tmp_path):
    open_set(tmp_path / "set", ShardsExporter)
    shard = tmp_path / "set" / "train_web" / "shard-000000.tar"
    with tarfile.open(shard) as file:
        assert list_members(shard) == [(info.name, info.offset_data, info.size) for info in file]


@settings(max_examples=fuzz_examples(100), deadline=None)
@given(st.data())
def test_a_changed_shard_is_listed_or_named(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "changed.tar"
    content = bytearray(tar((member("000000_000000.gt.json", 4), b"[{}]"), (member("b", 600), bytes(600))))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        listed = list_members(path)
    except DatasetError as error:
        assert str(error).isprintable()  # noqa: PT017
    else:
        assert all(0 <= offset <= offset + size <= path.stat().st_size for _, offset, size in listed)


RUNS = {"counts": [SIZE[0] * SIZE[1]], "size": [SIZE[1], SIZE[0]]}


@pytest.mark.parametrize(
    ("masks", "said"),
    [
        ({}, "has no mask 0, but there are 1 instances"),
        ({"0": RUNS | {"counts": [1]}}, "its runs have 1 of"),
        ({"0": RUNS | {"counts": [-1]}}, "expected int >= 0"),
        ({"0": RUNS | {"counts": [2**30] * 10}}, "its runs have 10737418240 of"),
        ({"0": RUNS | {"size": [8000, 8000]}}, "mask 0, has 8000 x 8000 pixels"),
        ({"0": RUNS | {"size": [1]}}, "expected array of length 2"),
        ([], "expected object, got array"),
    ],
)
def test_run_lengths_that_do_not_fill_the_image_are_named(tmp_path, masks, said):
    data = json.dumps(masks).encode()
    path = tmp_path / "shard-000000.tar"
    path.write_bytes(tar((member("000000_000000.mask.json", len(data)), data)))
    with pytest.raises(DatasetError, match=said):
        SceneShards([path], 0, SIZE).masks("mask", 0, 1)
