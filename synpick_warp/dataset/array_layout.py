"""Plausibility of a zarr array's metadata: shape, type, chunks and codecs are compared with the schema and with what is stored.

Metadata may be edited or damaged, and memory, loops and code follow from them. So they are checked before zarr sees the array.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta, Struct

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.trajectory.arrays import LABELS, ArraySpec
from synpick_warp.system.inputs.files import describe_bytes

if TYPE_CHECKING:
    import numpy as np

MAX_STEPS_PER_TICK = 1000
"""As in `physics.steps_per_tick`."""
_MAX_CHUNK_TICKS = 4096
"""As in `trajectory.chunk_ticks`: an array may have one chunk that is longer than itself."""
_MAX_ARRAY = 2**36
"""Largest array [bytes]: 64 GiB, the poses of as many objects as a world has room for in 9 million steps."""
_SMALL, _MAX_RATIO = 2**20, 1000
"""Arrays whose shape nothing else tells: size that any may have [bytes], and most bytes for each byte that is stored."""
_FEW_STEPS, _STEPS_PER_BYTE = 100_000, 8
"""Steps up to which nothing is compared, and most steps for each stored byte of their times. Of regular times in float64 zstd's highest
level makes one byte of five."""
_FEW_CHUNKS = 1000
"""Number of chunks that any array may have, in addition to one a row; every one takes Python a tenth of a millisecond."""

_Sizes = list[Annotated[int, Meta(ge=1, lt=2**40)]]


class _ChunkShape(Struct):
    """Schema of a chunk grid's configuration in zarr.json."""

    chunk_shape: _Sizes


class _ChunkGrid(Struct):
    """Schema of a regular chunk grid in zarr.json."""

    name: Literal["regular"]
    configuration: _ChunkShape


class _IndexCodec(Struct):
    """Schema of a codec of a shard's index in zarr.json."""

    name: Literal["bytes", "crc32c"]


class _CodecSettings(Struct):
    """Schema of a codec's configuration; only `sharding_indexed` has these keys."""

    chunk_shape: _Sizes | None = None
    codecs: list[_Codec] = []
    index_codecs: list[_IndexCodec] = []


class _Codec(Struct):
    """Schema of a codec in zarr.json, with its configuration."""

    name: Literal["bytes", "zstd", "crc32c", "sharding_indexed"]
    configuration: _CodecSettings | None = None


class ArrayMetadata(Struct):
    """Schema of an array's zarr.json: shape, type, chunks and codecs; others than these codecs and types are never loaded."""

    zarr_format: Literal[3]
    node_type: Literal["array"]
    shape: Annotated[list[Annotated[int, Meta(ge=0, lt=2**40)]], Meta(max_length=8)]
    data_type: Literal["bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]
    chunk_grid: _ChunkGrid
    codecs: list[_Codec]


def check_layout(folder: Path, metadata: ArrayMetadata, spec: ArraySpec | None, sizes: Mapping[str, int]) -> int:
    """Check an array's type, shape, chunks and codecs.

    Args:
        folder: The array.
        metadata: Its metadata.
        spec: Its schema; None: the array is none of ours.
        sizes: Known sizes of dimensions, by name.

    Returns:
        Largest size that a file of it may have [bytes].

    Raises:
        DatasetError: They do not fit the schema, or are too large for what is stored.
    """
    import numpy as np

    shape, dtype = tuple(metadata.shape), np.dtype(metadata.data_type)
    _check_extent(folder, _check_shape(folder, shape, dtype, spec, sizes), math.prod(shape) * dtype.itemsize, sizes.get("tick"))
    if spec is not None and spec.dims[0] == "step":
        _check_steps(folder, shape[0])
    levels = _chunk_shapes(metadata)
    rows = _MAX_CHUNK_TICKS * (MAX_STEPS_PER_TICK if spec is None or spec.dims[0] == "step" else 1)
    _check_chunks(folder, shape, levels, rows)
    chunk, inner = math.prod(levels[0]), math.prod(levels[0]) // max(1, math.prod(levels[-1]))
    # Data that zstd cannot compress grow by less than a hundredth; an index has 16 bytes a chunk.
    return chunk * dtype.itemsize * 101 // 100 + 1024 * (inner + 1)


def _check_shape(folder: Path, shape: tuple[int, ...], dtype: np.dtype, spec: ArraySpec | None, sizes: Mapping[str, int]) -> dict[str, int]:
    """Compare type and shape with the schema (None: any); returns name and size of the dimensions whose sizes nothing determines."""
    import numpy as np

    if spec is None:
        return {f"dimension {axis}": size for axis, size in enumerate(shape)}
    expected = tuple(len(LABELS[name]) if name in LABELS else sizes.get(name) for name in spec.dims)
    fits = len(shape) == len(expected) and all(size in (None, given) for size, given in zip(expected, shape, strict=True))
    if dtype != np.dtype(spec.dtype) or not fits:
        wanted = " x ".join(name if size is None else str(size) for name, size in zip(spec.dims, expected, strict=True))
        there = f"{dtype.name} of shape {' x '.join(map(str, shape))}"
        raise DatasetError(f"the array {folder} is {there}; expected: {np.dtype(spec.dtype).name} of shape {wanted}; {ADVICE}")
    return {name: given for name, size, given in zip(spec.dims, expected, shape, strict=True) if size is None}


def _check_extent(folder: Path, free: Mapping[str, int], size: int, ticks: int | None) -> None:
    """Compare the sizes that an array states and nothing else determines with the largest possible, or with what is stored.

    Args:
        folder: The array.
        free: These sizes, by dimension.
        size: Size of the array [bytes].
        ticks: Number of frames, if it is known.
    """
    most = {"instance": MAX_INSTANCES, "lift_tick": ticks}
    stored = _stored_bytes(folder)
    exceeds = any(given > (most.get(name) or given) for name, given in free.items())
    if exceeds or size > _MAX_ARRAY or (free.keys() - most.keys() and size > _SMALL + _MAX_RATIO * stored):
        there = " and ".join(f"{given:,} as {name}" for name, given in free.items()) or describe_bytes(size)
        raise DatasetError(f"the array {folder} states {there}, more than its {describe_bytes(stored)} can hold; {ADVICE}")


def _check_steps(folder: Path, steps: int) -> None:
    """Compare the number of steps with the stored size of their times, of which no two are the same."""
    times = folder.parent / "time"
    stored = _stored_bytes(times) if times.is_dir() else 0
    if steps > _FEW_STEPS + _STEPS_PER_BYTE * stored:
        raise DatasetError(
            f"the array {folder} states {steps:,} steps, more than the {describe_bytes(stored)} of their times can hold; {ADVICE}"
        )


def _stored_bytes(folder: Path) -> int:
    """Size of the files of an array [bytes]."""
    return sum(entry.stat(follow_symlinks=False).st_size for entry in os.scandir(folder))


def _chunk_shapes(metadata: ArrayMetadata) -> list[Sequence[int]]:
    """Shapes of the chunks, from the files down to what is compressed together."""
    levels: list[Sequence[int]] = [metadata.chunk_grid.configuration.chunk_shape]
    codecs = metadata.codecs
    while shards := [codec.configuration for codec in codecs if codec.configuration is not None and codec.configuration.chunk_shape]:
        levels.append(shards[0].chunk_shape or ())
        codecs = shards[0].codecs
    return levels


def _check_chunks(folder: Path, shape: Sequence[int], levels: Sequence[Sequence[int]], rows: int) -> None:
    """Raise DatasetError if chunks are larger than the array, but for the end of the last one, or more than one a row and _FEW_CHUNKS.

    Args:
        folder: The array.
        shape: Its shape.
        levels: Shapes of its chunks, from the files down.
        rows: Most rows of a chunk in an array that has less.
    """
    extents = [max(1, size) for size in shape]
    if any(len(level) != len(extents) for level in levels):
        raise DatasetError(f"the array {folder} has chunks of another shape; {ADVICE}")
    if not extents:
        return
    most = [max(rows, extents[0]), *extents[1:]]
    innermost = levels[-1]
    padded = [extents[0] + innermost[0], *extents[1:]]
    for level, limits in [*((level, padded) for level in levels[:-1]), (innermost, most)]:
        if any(size > limit for size, limit in zip(level, limits, strict=True)):
            there = f"chunks of {' x '.join(map(str, level))}"
            raise DatasetError(f"the array {folder} has {there}, larger than its {' x '.join(map(str, shape))}; {ADVICE}")
    count = math.prod(-(-size // part) for size, part in zip(extents, innermost, strict=True))
    if count > extents[0] + _FEW_CHUNKS:
        raise DatasetError(f"the array {folder} has {count:,} chunks for {shape[0]:,} rows; allowed: one a row; {ADVICE}")
