"""Hostile zarr arrays: compressed chunks that inflate, chunks and sizes that are larger than what is stored."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import msgspec
import numcodecs.zstd
import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.array_layout import ArrayMetadata, check_layout
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.trajectory.arrays import STEPS
from tests.worlds import trajectories

HUGE = 2**26
BLOCK = 2**17
"""Largest block of a Zstandard frame [bytes]."""


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    return trajectories.write_set(tmp_path_factory.mktemp("arrays") / "set", trajectories.config(), (0,), 3)


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
def test_a_chunk_that_holds_more_or_less_than_its_place_is_not_decompressed(written, tmp_path, name, sharded):
    store = Path(shutil.copytree(written, tmp_path / "set"))
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


def test_a_chunk_file_is_no_larger_than_its_chunk(written, tmp_path):
    """A file with a hole of gigabytes would be read whole."""
    store = Path(shutil.copytree(written, tmp_path / "set"))
    [chunk] = (store / "trajectory.zarr/objects/mass").glob("c.*")
    with chunk.open("r+b") as stream:
        stream.truncate(2**33)
    with pytest.raises(DatasetError, match=r"c\.0 is larger than"):
        _ = synpick_warp.open(store).objects
