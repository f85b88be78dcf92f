"""Hostile images, annotations, shards and zarr arrays of a data set: each is a DatasetError of one line, before memory is filled.
Compressed chunks inflate, chunks and sizes are larger than what is stored."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import struct
import tarfile
import zlib
from contextlib import nullcontext
from pathlib import Path

import cv2
import numcodecs.zstd
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import synpick_warp
from synpick_warp.dataset.annotations import MASK_SCHEMA, VIEW_SCHEMAS, Key, ModelInfo, check_json
from synpick_warp.dataset.commit.manifest import CONSTANTS, encode_manifest
from synpick_warp.dataset.stored_array import open_array
from synpick_warp.dataset.trajectory import GroupContext
from synpick_warp.dataset.view_files import SceneShards
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.bop.shards import ShardsExporter, key_lines
from synpick_warp.exporters.trajectory.arrays import STEPS
from synpick_warp.system.inputs.image_files import decode_image, image_size
from synpick_warp.system.inputs.tar_files import list_members
from synpick_warp.testing.exporters import LENSES
from tests.harness.hostile import fuzz_examples, places, replaced
from tests.worlds import trajectories
from tests.worlds.box_sets import write_set
from tests.worlds.model_files import pack_png

SIZE = LENSES[0].width, LENSES[0].height


def open_set(folder: Path, exporter: type = BopExporter) -> synpick_warp.DataSet:
    """A data set of boxes."""
    return synpick_warp.open(write_set(folder, exporter))


# ---- images ----


def bomb(width: int, height: int) -> bytes:
    """A PNG that states a size and has hardly any data."""
    return pack_png(width, height, (b"IDAT", zlib.compress(bytes(100))), depth=16, kind=2)


UNKNOWN = (b"", b"II*\x00" + bytes(100), b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xff\xff\xff\x03", b"\xff\xd8" + b"\xff\xe0\x00\x02" * 10_000)
UNKNOWN += (b"\xff\xd8" + b"\xff" * 100_000, b"\x89PNG\r\n\x1a\n")
SIZES = {
    "F has 100000 x 100000 pixels; allowed: up to 8192 x 8192": bomb(100_000, 100_000),
    "F has 0 x 5 pixels": bomb(0, 5),
    "F has 2147483649 x 1 pixels": bomb(2**31 + 1, 1),
    "F has 65535 x 65535 pixels": cv2.imencode(".jpg", np.zeros((7, 11)))[1].tobytes().replace(b"\0\7\0\13", b"\xff" * 4),
}


IMAGES = [*((data, "is not an image: neither PNG nor JPEG") for data in UNKNOWN), *((data, said) for said, data in SIZES.items())]


@pytest.mark.parametrize(("data", "said"), IMAGES)
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
        assert str(error).startswith("F")  # noqa: PT017
        assert str(error).isprintable()  # noqa: PT017


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
        ("rgb/000000.png", b"no image", "rgb", r"000000\.png is not an image"),
        ("rgb/000000.png", None, "rgb", r"000000\.png is not a regular file"),
    ],
)
def test_an_image_that_does_not_fit_its_camera_is_named(tmp_path, name, content, part, said):
    """Without content: a pipe, for which nobody waits."""
    data = open_set(tmp_path / "set")
    file = data.folder / "train" / "000000" / name
    file.unlink()
    os.mkfifo(file) if content is None else file.write_bytes(content)
    view = data[0].view(0)
    with pytest.raises(DatasetError, match=said):
        _ = view.layer(part) if part == "flow" else getattr(view, part)


# ---- annotations ----


@pytest.mark.parametrize(
    ("name", "place", "value", "said"),
    [
        ("camera", (0, "cam_K"), [1.0] * 8, r"scene_camera\.json is damaged: expected array of length >= 9 - at \$\[\.\.\.\]\.cam_K"),
        ("camera", (0, "depth_scale"), "0.1", r"expected float, got str"),
        ("camera", (0, "cam_R_w2c"), [0.0] * 9, r"the camera of image 0 has a cam_R_w2c that is no rotation"),
        ("camera", (0, "cam_R_w2c"), [1, 0, 0, 0, 1, 0, 0, 0, -1], r"the camera of image 0 has a cam_R_w2c that is no rotation"),
        ("camera", (0, "cam_K"), [0.0] * 9, r"the camera of image 0 has no focal length above 0"),
        ("gt", (0, 0, "cam_t_m2c"), [0.0, 0.0, 10**30], r"expected float <= 1000000000"),
        ("gt", (0, 0), 3, r"expected object, got int"),
        ("gt", (0, 0, "obj_id"), -1, r"expected int >= 0"),
        ("gt", (0,), [], r"do not agree about image 0"),
        ("gt_info", (0, 0, "bbox_visib"), [1, 2, 3], r"of length >= 4"),
        ("gt_info", (0, 0, "px_count_all"), -5, r"expected int >= 0"),
        ("gt", (0, 0), "x", r"scene_gt\.json is damaged: expected object, got str"),
        ("gt", (0, 0, "obj_id"), [], r"expected int, got array"),
        ("gt_info", (0, 0, "px_count_visib"), "3", r"expected int, got str"),
        ("gt_info", (0, 0, "bbox_obj"), [1e300] * 4, r"expected int"),
        ("gt_info", (0, 0, "visib_fract"), float("nan"), r"JSON is malformed"),
        ("camera", (0, "depth_scale"), None, r"expected float, got null"),
        ("camera", (0, "cam_R_w2c"), 3, r"expected array, got int"),
    ],
)
def test_a_wrong_annotation_is_named_with_file_and_place(tmp_path, name, place, value, said):
    data = open_set(tmp_path / "set")
    path = data.folder / "train" / "000000" / f"scene_{name}.json"
    path.write_text(json.dumps(replaced(json.loads(path.read_text()), (str(place[0]), *place[1:]), value)))
    view = data[0].view(0)
    with pytest.raises(DatasetError, match=said) as caught:
        _ = view.boxes, view.object_to_world, view.intrinsics
    assert str(caught.value).isprintable()


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
    lengths = {"cam_K": 9, "cam_R_m2c": 9, "cam_t_m2c": 3, "bbox_obj": 4, "bbox_visib": 4}
    for record in [entry] if name == "camera" else entry:
        assert all(len(record[key]) == length and np.isfinite(record[key]).all() for key, length in lengths.items() if key in record)


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


ODD = ((tarfile.SYMTYPE, "/etc/passwd"), (tarfile.LNKTYPE, "b"), (tarfile.CHRTYPE, ""), (tarfile.GNUTYPE_SPARSE, ""))
SHARDS = [(tar((member("a", type=kind, linkname=target), b"")), "has a member at byte 0 that is not a regular") for kind, target in ODD]
SHARDS += [
    (tar((member("ü" * 200), b""), form=tarfile.PAX_FORMAT), "not a regular file"),
    ((member("pax", 13, type=tarfile.XHDTYPE).tobuf() + b"12 path=abcd\n".ljust(512, b"\0")) * 5000, "not a regular file"),
    (lying(2**60), "the member at byte 0 has 1073741824 GiB"),
    (lying(10), "the member at byte 0 has 10 bytes"),
    (lying(10)[:300], "truncated header"),
    (b"x" * 512, "is damaged: "),
    (tar((member("a", 5), b"12345"))[:514], "the member at byte 0 has 5 bytes"),
]


@pytest.mark.parametrize(("content", "said"), SHARDS)
def test_a_hostile_shard_is_named(tmp_path, content, said):
    path = tmp_path / "shard-000000.tar"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=said) as caught:
        key_lines(path)
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


# ---- zarr arrays ----

HUGE = 2**26
BLOCK = 2**17
"""Largest block of a Zstandard frame [bytes]."""


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    return trajectories.write_set(tmp_path_factory.mktemp("arrays") / "set", trajectories.config(), (0,), 3)


@pytest.fixture
def store(written, tmp_path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "set"))


def repeated_byte(size: int, header: bytes = b"\x00\x58") -> bytes:
    """Zstandard frame of `size` equal bytes in 4 bytes a block; `header`: descriptor, window, and content size if it is to state one."""
    counts = [BLOCK] * (size // BLOCK) + [size % BLOCK] * (size % BLOCK > 0)
    blocks = (((count << 3) | 2 | (index == len(counts) - 1)).to_bytes(3, "little") + b"A" for index, count in enumerate(counts))
    return b"\x28\xb5\x2f\xfd" + header + b"".join(blocks)


FRAMES = {
    "stated": (numcodecs.zstd.compress(bytes(2**26), 3), "holds 67,108,864 bytes instead of"),
    "not stated": (repeated_byte(HUGE), "too small"),
    "stated wrongly": (b"SIZE", "too small"),
    "stated, impossible": (repeated_byte(8, b"\xc0\x58" + struct.pack("<Q", 2**62)), "holds 4,611,686,018,427,387,904 bytes"),
    "too short": (numcodecs.zstd.compress(bytes(8), 3), "holds 8 bytes instead of"),
    "too short, not stated": (repeated_byte(8), "expected to decompress"),
    "none": (b"no frame", "invalid"),
}


@pytest.mark.parametrize("sharded", [False, True])
@pytest.mark.parametrize("name", FRAMES)
def test_a_chunk_that_holds_more_or_less_than_its_place_is_not_decompressed(store, name, sharded):
    array = store / "trajectory.zarr/episodes/000000/steps/pose"
    metadata = json.loads((array / "zarr.json").read_text())
    shard = metadata["codecs"][0]["configuration"]
    shard["index_codecs"] = shard["index_codecs"][:1]
    shard["chunk_shape"] = metadata["chunk_grid"]["configuration"]["chunk_shape"] = metadata["shape"]
    frame, said = FRAMES[name]
    if frame == b"SIZE":
        frame = repeated_byte(HUGE, b"\xc0\x58" + struct.pack("<Q", 4 * int(np.prod(metadata["shape"]))))
    if not sharded:
        metadata["codecs"] = shard["codecs"]
    (array / "zarr.json").write_text(json.dumps(metadata))
    index = struct.pack("<QQ", 0, len(frame)) if sharded else b""
    (array / "c.0.0.0").write_bytes(frame + index)
    with pytest.raises(DatasetError, match=said):
        _ = synpick_warp.open(store)[0].steps["pose"][...]


def layout(shape: list[int], *chunks: list[int], dtype: str = "float32") -> dict:
    """Metadata of an array with these chunk shapes, from the files down."""
    codecs: list[dict] = [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "zstd", "configuration": {"level": 1}}]
    for chunk in reversed(chunks[1:]):
        configuration = {"chunk_shape": chunk, "codecs": codecs, "index_codecs": codecs[:1]}
        codecs = [{"name": "sharding_indexed", "configuration": configuration}]
    grid = {"name": "regular", "configuration": {"chunk_shape": chunks[0]}}
    keys = {"chunk_key_encoding": {"name": "default"}, "fill_value": 0, "zarr_format": 3, "node_type": "array"}
    return keys | {"shape": shape, "data_type": dtype, "chunk_grid": grid, "codecs": codecs}


MOVED = [99, 24, 7]
LAYOUTS = [
    (layout(MOVED, [33792, 24, 7], [528, 24, 7]), 400, "larger than its 99 x 24 x 7"),
    (layout(MOVED, [528, 24, 7], [528, 24, 7]), 400, ""),
    (layout(MOVED, [4_096_000, 24, 7], [4_096_000, 24, 7]), 400, ""),
    (layout(MOVED, [4_096_001, 24, 7]), 400, "larger than its"),
    (layout(MOVED, [99, 24, 8]), 400, "larger than its"),
    (layout(MOVED, [99, 24]), 400, "cannot be read: .* the same number of dimensions"),
    (layout(MOVED, [1, 24, 7]), 400, ""),
    (layout(MOVED, MOVED, [1, 1, 1]), 400, "16,632 chunks for 99 rows"),
    (layout([99, 252, 7], [99, 252, 7]), 400, "252 as instance"),
    (layout([990_000, 24, 7], [528, 24, 7]), 400, "990,000 steps, more than the 400 bytes of their times"),
    (layout([990_000, 24, 7], [528, 24, 7]), 200_000, ""),
    # Arrays of others have no specification.
    (layout([1000, 100], [1000, 100]), None, ""),
    (layout([100_000_000], [1000]), None, "states 100,000,000 as dimension 0"),
    (layout([10], [0]), None, "cannot be read: |chunks of another shape"),
    (layout([10], [10], dtype="string"), None, "cannot be read"),
]


@pytest.mark.parametrize(("metadata", "times", "said"), LAYOUTS)
def test_a_layout_fits_the_shape_and_what_is_stored(tmp_path, metadata, times, said):
    for name in ("pose", "time"):
        (tmp_path / name).mkdir()
    (tmp_path / "pose" / "zarr.json").write_text(json.dumps(metadata))
    (tmp_path / "time" / "c.0").write_bytes(bytes(times or 0))
    context = GroupContext(lambda: {"step": metadata["shape"][0], "tick": 30_000} if times else {})
    with pytest.raises(DatasetError, match=said) if said else nullcontext():
        open_array(tmp_path / "pose", STEPS.arrays["pose"] if times else None, context)


def test_a_chunk_file_is_no_larger_than_its_chunk(store):
    """A file with a hole of gigabytes would be read whole."""
    [chunk] = (store / "trajectory.zarr/objects/mass").glob("c.*")
    with chunk.open("r+b") as stream:
        stream.truncate(2**33)
    with pytest.raises(DatasetError, match=r"c\.0 is larger than"):
        _ = synpick_warp.open(store).objects


def change(path: Path, place: tuple[object, ...], value: object) -> None:
    path.write_text(json.dumps(replaced(json.loads(path.read_text()), place, value)))


POSE = "steps/pose"
METADATA = [
    (POSE, ("shape", 0), 10**12, "is float32 of shape .*; expected: float32 of shape 12 x instance x 7"),
    (POSE, ("shape",), [12], "cannot be read: .* the same number of dimensions"),
    (POSE, ("shape", 1), 2**39, "more than its .* can hold"),
    (POSE, ("data_type",), "float64", "is float64 of shape .*; expected: float32"),
    (POSE, ("data_type",), "null_terminated_bytes", "cannot be read: "),
    (POSE, ("codecs", 0, "name"), "pickle", "cannot be read: .*pickle"),
    (POSE, ("codecs", 0, "configuration", "chunk_shape", 0), 7, "cannot be read: "),
    (POSE, ("codecs", 0, "configuration"), None, "cannot be read: "),
    (POSE, ("chunk_grid", "configuration", "chunk_shape", 0), 0, "cannot be read: |chunks of another shape"),
    (POSE, ("fill_value",), "x", "cannot be read: "),
    (POSE, ("chunk_grid", "configuration", "chunk_shape", 1), 2**33, "larger than its"),
    (POSE, ("chunk_grid", "configuration", "chunk_shape", 0), 2**33, "larger than its"),
    (POSE, ("codecs", 0, "configuration", "chunk_shape", 2), 2**33, "cannot be read: .*8589934592"),
    (POSE, ("codecs", 0, "configuration", "chunk_shape"), [2, 2], "cannot be read: |chunks of another shape"),
    (POSE, ("codecs", 0, "configuration", "codecs", 1, "name"), "pickle", "cannot be read: .*pickle"),
    (
        POSE,
        ("codecs", 0, "configuration", "codecs", 1),
        {"name": "gzip", "configuration": {"level": 1}},
        "the codec gzip is not allowed here",
    ),
    (POSE, ("codecs", 0, "configuration", "index_codecs", 1, "name"), "zstd", "cannot be read: "),
    ("attempts/record", ("shape", 0), 2**30, "states"),
    ("attempts/frame", ("shape", 0), 2**30, "states"),
    ("attempts/peak_force", ("shape", 1), 2**30, "states"),
    ("ticks/pose", ("shape", 1), 2**30, "states"),
]


@pytest.mark.parametrize(("array", "place", "value", "said"), METADATA)
def test_metadata_of_an_array_that_do_not_fit_are_named(store, array, place, value, said):
    change(store / "trajectory.zarr/episodes/000000" / array / "zarr.json", place, value)
    (group, name), episode = array.split("/"), synpick_warp.open(store)[0]
    with pytest.raises(DatasetError, match=said) as caught:
        _ = {"steps": episode.steps, "ticks": episode.ticks, "attempts": episode.attempt_arrays}[group][name][...]
    assert str(caught.value).isprintable()


def test_a_damaged_chunk_is_named_and_a_wrong_index_is_an_index_error(store):
    array = store / "trajectory.zarr/episodes/000000/steps/pose"
    [chunk] = [path for path in array.iterdir() if path.name != "zarr.json"]
    steps = synpick_warp.open(store)[0].steps
    with pytest.raises(IndexError):
        _ = steps["pose"][10**6]
    chunk.write_bytes(chunk.read_bytes()[:50])
    for read in (lambda pose: pose[...], lambda pose: pose[0, 0], np.asarray, lambda pose: pose.oindex[[0]]):
        with pytest.raises(DatasetError, match=r"the array .*/steps/pose cannot be read: .*; restore the file"):
            read(steps["pose"])
    chunk.unlink()
    os.mkfifo(chunk)
    with pytest.raises(DatasetError, match="is not a regular file"):
        _ = steps["pose"]


def test_a_chunk_that_the_manifest_lists_must_be_there(store):
    """Zarr reads a missing chunk as NaN or 0."""
    (store / "manifest").mkdir(exist_ok=True)
    array = store / "trajectory.zarr/objects/mass"
    lines = "".join(f"{'0' * 64}  {path.relative_to(store)}\n" for path in sorted(array.iterdir()))
    write_entry(store, lines)
    assert len(synpick_warp.open(store).objects) > 0
    (array / "c.0").unlink()
    with pytest.raises(DatasetError, match=r"there is no .*objects/mass/c\.0, which the manifest lists"):
        _ = synpick_warp.open(store).objects
    write_entry(store, f"{'0' * 64}  trajectory.zarr/../../outside\n")
    with pytest.raises(DatasetError, match=r"constants\.sha256, line 1, names the file"):
        _ = synpick_warp.open(store).objects


def write_entry(store: Path, lines: str) -> None:
    """Write the manifest entry of the constants."""
    content = {"files": lines.count("\n"), "checksum": hashlib.sha256(lines.encode()).hexdigest(), "bytes": 0}
    (store / f"{CONSTANTS}.sha256").write_text(lines)
    (store / f"{CONSTANTS}.json").write_bytes(encode_manifest(content))


def test_tables_whose_lengths_differ_are_named(store):
    wrong = {"expected: .* of shape 1": ["one"], r"zarr\.json is damaged: expected array, got int - at \$\.names": 3}
    for said, names in wrong.items():
        change(store / "trajectory.zarr/objects/zarr.json", ("attributes", "names"), names)
        with pytest.raises(DatasetError, match=said):
            _ = synpick_warp.open(store).objects


def test_folders_with_other_names_are_no_episodes(store):
    for name in ("12abc", "0", "000²", "notes"):
        (store / "trajectory.zarr" / "episodes" / name).mkdir()
    assert list(synpick_warp.open(store)) == [0]
