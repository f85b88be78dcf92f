"""Hostile zarr arrays: compressed chunks that inflate, chunks and sizes that are larger than what is stored."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import struct
from pathlib import Path

import msgspec
import numcodecs.zstd
import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.commit.manifest import CONSTANTS, encode_manifest
from synpick_warp.dataset.stored_array import ArrayMetadata, check_layout
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.trajectory.arrays import STEPS
from tests.harness.hostile import replaced
from tests.worlds import trajectories

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


def layout(shape: list[int], *chunks: list[int], dtype: str = "float32") -> ArrayMetadata:
    """Metadata of an array with these chunk shapes, from the files down."""
    codecs: list[dict] = [{"name": "bytes"}, {"name": "zstd"}]
    for chunk in reversed(chunks[1:]):
        codecs = [{"name": "sharding_indexed", "configuration": {"chunk_shape": chunk, "codecs": codecs}}]
    grid = {"name": "regular", "configuration": {"chunk_shape": chunks[0]}}
    content = {"zarr_format": 3, "node_type": "array", "shape": shape, "data_type": dtype, "chunk_grid": grid, "codecs": codecs}
    return msgspec.convert(content, ArrayMetadata)


@pytest.mark.parametrize(
    ("metadata", "times", "said"),
    [
        (layout([99, 24, 7], [33792, 24, 7], [528, 24, 7]), 400, "larger than its 99 x 24 x 7"),
        (layout([99, 24, 7], [528, 24, 7], [528, 24, 7]), 400, ""),
        (layout([99, 24, 7], [4_096_000, 24, 7], [4_096_000, 24, 7]), 400, ""),
        (layout([99, 24, 7], [4_096_001, 24, 7]), 400, "larger than its"),
        (layout([99, 24, 7], [99, 24, 8]), 400, "larger than its"),
        (layout([99, 24, 7], [99, 24]), 400, "chunks of another shape"),
        (layout([99, 24, 7], [1, 24, 7]), 400, ""),
        (layout([99, 24, 7], [99, 24, 7], [1, 1, 1]), 400, "16,632 chunks for 99 rows"),
        (layout([99, 252, 7], [99, 252, 7]), 400, "252 as instance"),
        (layout([990_000, 24, 7], [528, 24, 7]), 400, "990,000 steps, more than the 400 bytes of their times"),
        (layout([990_000, 24, 7], [528, 24, 7]), 200_000, ""),
    ],
)
def test_a_layout_fits_the_shape_and_what_is_stored(tmp_path, metadata, times, said):
    for name in ("pose", "time"):
        (tmp_path / name).mkdir()
    (tmp_path / "time" / "c.0").write_bytes(bytes(times))
    sizes = {"step": metadata.shape[0], "tick": 30_000}
    if not said:
        assert check_layout(tmp_path / "pose", metadata, STEPS.arrays["pose"], sizes) < 2**33
        return
    with pytest.raises(DatasetError, match=said):
        check_layout(tmp_path / "pose", metadata, STEPS.arrays["pose"], sizes)


def test_an_array_of_others_is_compared_with_what_is_stored(tmp_path):
    array = tmp_path / "mine"
    array.mkdir()
    check_layout(array, layout([1000, 100], [1000, 100]), None, {})
    with pytest.raises(DatasetError, match="states 100,000,000 as dimension 0"):
        check_layout(array, layout([100_000_000], [1000]), None, {})


def test_a_chunk_file_is_no_larger_than_its_chunk(store):
    """A file with a hole of gigabytes would be read whole."""
    [chunk] = (store / "trajectory.zarr/objects/mass").glob("c.*")
    with chunk.open("r+b") as stream:
        stream.truncate(2**33)
    with pytest.raises(DatasetError, match=r"c\.0 is larger than"):
        _ = synpick_warp.open(store).objects


# ---- metadata ----


def change(path: Path, place: tuple[object, ...], value: object) -> None:
    path.write_text(json.dumps(replaced(json.loads(path.read_text()), place, value)))


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("shape", 0), 10**12, "is float32 of shape .*; expected: float32 of shape 12 x instance x 7"),
        (("shape",), [12], "is float32 of shape 12; expected"),
        (("shape", 1), 2**39, "more than its .* can hold"),
        (("data_type",), "float64", "is float64 of shape .*; expected: float32"),
        (("data_type",), "null_terminated_bytes", "invalid enum value"),
        (("codecs", 0, "name"), "pickle", "invalid enum value 'pickle'"),
        (("codecs", 0, "configuration", "chunk_shape", 0), 7, "cannot be read: "),
        (("codecs", 0, "configuration"), None, "cannot be read: "),
        (("chunk_grid", "configuration", "chunk_shape", 0), 0, "expected int >= 1"),
        (("fill_value",), "x", "cannot be read: "),
        (("chunk_grid", "configuration", "chunk_shape", 1), 2**33, "larger than its"),
        (("chunk_grid", "configuration", "chunk_shape", 0), 2**33, "larger than its"),
        (("codecs", 0, "configuration", "chunk_shape", 2), 2**33, "larger than its"),
        (("codecs", 0, "configuration", "chunk_shape"), [2, 2], "chunks of another shape"),
        (("codecs", 0, "configuration", "codecs", 1, "name"), "pickle", "invalid enum value 'pickle'"),
        (("codecs", 0, "configuration", "index_codecs", 1, "name"), "zstd", "invalid enum value 'zstd'"),
    ],
)
def test_metadata_of_an_array_that_do_not_fit_are_named(store, place, value, said):
    change(store / "trajectory.zarr/episodes/000000/steps/pose/zarr.json", place, value)
    steps = synpick_warp.open(store)[0].steps
    with pytest.raises(DatasetError, match=said) as caught:
        _ = steps["pose"][...]
    assert str(caught.value).isprintable()


def test_a_damaged_chunk_is_named_and_a_wrong_index_is_an_index_error(store):
    array = store / "trajectory.zarr/episodes/000000/steps/pose"
    [chunk] = [path for path in array.iterdir() if path.name != "zarr.json"]
    steps = synpick_warp.open(store)[0].steps
    with pytest.raises(IndexError):
        _ = steps["pose"][10**6]
    chunk.write_bytes(chunk.read_bytes()[:50])
    for read in (
        lambda: steps["pose"][...],
        lambda: steps["pose"][0, 0],
        lambda: np.asarray(steps["pose"]),
        lambda: steps["pose"].oindex[[0]],
    ):
        with pytest.raises(DatasetError, match=r"the array .*/steps/pose cannot be read: .*; restore the file"):
            read()
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
    change(store / "trajectory.zarr/objects/zarr.json", ("attributes", "names"), ["one"])
    with pytest.raises(DatasetError, match=r"expected: .* of shape 1"):
        _ = synpick_warp.open(store).objects
    change(store / "trajectory.zarr/objects/zarr.json", ("attributes", "names"), 3)
    with pytest.raises(DatasetError, match=r"zarr\.json is damaged: expected array, got int - at \$\.names"):
        _ = synpick_warp.open(store).objects


def test_folders_with_other_names_are_no_episodes(store):
    for name in ("12abc", "0", "000²", "notes"):
        (store / "trajectory.zarr" / "episodes" / name).mkdir()
    assert list(synpick_warp.open(store)) == [0]
