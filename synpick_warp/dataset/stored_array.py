"""Zarr arrays of a trajectory store: metadata are checked before zarr sees the array, and its faults are one error class.

Metadata may be edited or damaged, and memory, loops and code follow from them: so shape, type, chunks and codecs are compared with the
schema and with what is stored. Compressed chunks that hold more than their place in the array (decompression bombs, CWE-409), unknown
codecs and files that cannot be read are a DatasetError.

Imports zarr, so import it when an array is opened.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numcodecs.zstd
import numpy as np
import zarr
from msgspec import Meta, Struct
from zarr.codecs import ShardingCodec, ZstdCodec

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.trajectory import GROUP_FILE, MAX_METADATA, MAX_STEPS_PER_TICK, GroupContext
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.trajectory.arrays import LABELS, TrajectoryArray
from synpick_warp.system.inputs.files import check_regular_file, describe_bytes, read_file
from synpick_warp.system.inputs.json import decode_json
from synpick_warp.system.processes.threads import ZARR_THREADS

zarr.config.set(ZARR_THREADS)

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
_MAX_HEADER = 18
"""Largest header of a Zstandard frame [bytes]."""
_SELECTIONS = (
    "get_basic_selection",
    "get_orthogonal_selection",
    "get_mask_selection",
    "get_coordinate_selection",
    "get_block_selection",
)
"""The methods of an array that read chunks; indexing calls one of them."""

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


def open_array(folder: Path, spec: TrajectoryArray | None, context: GroupContext) -> StoredArray:
    """Open an array.

    Args:
        folder: The array.
        spec: Its schema; None: the array is none of ours.
        context: What it must agree with.

    Raises:
        DatasetError: Its metadata does not fit, a file is missing or too large, or zarr cannot open it.
    """
    path = folder / GROUP_FILE
    metadata = decode_json(read_file(path, MAX_METADATA, DatasetError), ArrayMetadata, path, DatasetError, ADVICE)
    _check_files(folder, check_layout(folder, metadata, spec, context.sizes()), context.files())
    try:
        opened = zarr.open_array(folder, mode="r").async_array
        bounded = dataclasses.replace(opened.metadata, codecs=_bound_codecs(opened.metadata.codecs))
        return StoredArray(type(opened)(bounded, opened.store_path, opened.config))
    except Exception as error:
        raise _unreadable(folder, error) from None


def _check_files(folder: Path, largest: int, listed: Collection[Path]) -> None:
    """Check that the chunk files that the manifest lists exist, and that all are regular files of up to `largest` bytes.

    Zarr reads a missing chunk file as fill values, and writes no file for a chunk of these: only the manifest shows that one was lost.
    """
    present = {folder / entry.name for entry in os.scandir(folder)}
    for path in sorted(path for path in listed if path.parent == folder and path not in present):
        raise DatasetError(f"there is no {path}, which the manifest lists; {ADVICE}")
    for path in present:
        check_regular_file(path, max(largest, MAX_METADATA) if path.name == GROUP_FILE else largest, DatasetError)


def check_layout(folder: Path, metadata: ArrayMetadata, spec: TrajectoryArray | None, sizes: Mapping[str, int]) -> int:
    """Check an array's type, shape, chunks and codecs against its schema (None: any) and the known `sizes` of dimensions.

    Returns:
        Largest size that a file of it may have [bytes].

    Raises:
        DatasetError: They do not fit the schema, or are too large for what is stored.
    """
    shape, dtype = tuple(metadata.shape), np.dtype(metadata.data_type)
    has_steps = spec is None or spec.dims[0] == "step"
    _check_extent(folder, _check_shape(folder, shape, dtype, spec, sizes), math.prod(shape) * dtype.itemsize, sizes.get("tick"))
    if spec is not None and has_steps:
        times = folder.parent / "time"
        stored = _stored_bytes(times) if times.is_dir() else 0
        if shape[0] > _FEW_STEPS + _STEPS_PER_BYTE * stored:
            there = f"states {shape[0]:,} steps, more than the {describe_bytes(stored)} of their times can hold"
            raise _fault(folder, there)
    levels = _chunk_shapes(metadata)
    _check_chunks(folder, shape, levels, _MAX_CHUNK_TICKS * (MAX_STEPS_PER_TICK if has_steps else 1))
    chunk, inner = math.prod(levels[0]), math.prod(levels[0]) // max(1, math.prod(levels[-1]))
    # Data that zstd cannot compress grow by less than a hundredth; an index has 16 bytes a chunk.
    return chunk * dtype.itemsize * 101 // 100 + 1024 * (inner + 1)


def _check_shape(
    folder: Path, shape: tuple[int, ...], dtype: np.dtype, spec: TrajectoryArray | None, sizes: Mapping[str, int]
) -> dict[str, int]:
    """Compare type and shape with the schema; returns name and size of the dimensions whose sizes nothing determines."""
    if spec is None:
        return {f"dimension {axis}": size for axis, size in enumerate(shape)}
    expected = tuple(len(LABELS[name]) if name in LABELS else sizes.get(name) for name in spec.dims)
    fits = len(shape) == len(expected) and all(size in (None, given) for size, given in zip(expected, shape, strict=True))
    if dtype != np.dtype(spec.dtype) or not fits:
        wanted = " x ".join(name if size is None else str(size) for name, size in zip(spec.dims, expected, strict=True))
        there = f"is {dtype.name} of shape {' x '.join(map(str, shape))}"
        raise _fault(folder, f"{there}; expected: {np.dtype(spec.dtype).name} of shape {wanted}")
    return {name: given for name, size, given in zip(spec.dims, expected, shape, strict=True) if size is None}


def _check_extent(folder: Path, free: Mapping[str, int], size: int, ticks: int | None) -> None:
    """Compare `free`, the sizes of dimensions that nothing determines, and the `size` of the array [bytes] with the largest possible, or
    with what is stored; `ticks`: number of frames, if it is known."""
    most = {"instance": MAX_INSTANCES, "lift_tick": ticks}
    stored = _stored_bytes(folder)
    exceeds = any(given > (most.get(name) or given) for name, given in free.items())
    if exceeds or size > _MAX_ARRAY or (free.keys() - most.keys() and size > _SMALL + _MAX_RATIO * stored):
        there = " and ".join(f"{given:,} as {name}" for name, given in free.items()) or describe_bytes(size)
        raise _fault(folder, f"states {there}, more than its {describe_bytes(stored)} can hold")


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
        raise _fault(folder, "has chunks of another shape")
    if not extents:
        return
    most = [max(rows, extents[0]), *extents[1:]]
    innermost = levels[-1]
    padded = [extents[0] + innermost[0], *extents[1:]]
    for level, limits in [*((level, padded) for level in levels[:-1]), (innermost, most)]:
        if any(size > limit for size, limit in zip(level, limits, strict=True)):
            there = f"has chunks of {' x '.join(map(str, level))}"
            raise _fault(folder, f"{there}, larger than its {' x '.join(map(str, shape))}")
    count = math.prod(-(-size // part) for size, part in zip(extents, innermost, strict=True))
    if count > extents[0] + _FEW_CHUNKS:
        raise _fault(folder, f"has {count:,} chunks for {shape[0]:,} rows; allowed: one a row")


def _fault(folder: Path, text: str) -> DatasetError:
    """Error about an array."""
    return DatasetError(f"the array {folder} {text}; {ADVICE}")


def _unreadable(folder: Path, error: Exception) -> DatasetError:
    """Error about an array that cannot be read, with the first 200 characters of the cause."""
    return _fault(folder, f"cannot be read: {' '.join(str(error).split())[:200] or type(error).__name__}")


class StoredArray(zarr.Array):
    """A read-only zarr array; reading raises DatasetError where zarr would raise an error of its own, except for a wrong index."""


class _BoundedZstd(ZstdCodec):
    """Zstandard codec (RFC 8878) that decompresses into an array of the chunk's size, so a frame that holds more fails without being
    decompressed further; zarr's own allocates whatever a frame states, or grows until it ends."""

    async def _decode_single(self, chunk_bytes: Any, chunk_spec: Any) -> Any:
        return await asyncio.to_thread(_decompress, chunk_bytes, chunk_spec)


def _decompress(chunk: Any, spec: Any) -> Any:
    """Decompress a zstd chunk; raises ValueError if its size is not that of the array's chunk."""
    frame, dtype = chunk.as_numpy_array(), spec.dtype
    size = math.prod(spec.shape) * (dtype.itemsize if isinstance(dtype, np.dtype) else dtype.item_size)
    stated = _content_size(frame[:_MAX_HEADER].tobytes())
    if stated not in (None, size):
        raise ValueError(f"a compressed chunk holds {stated:,} bytes instead of {size:,}")
    values = np.empty(size, np.uint8)
    numcodecs.zstd.decompress(frame, values)  # Fails unless the frame fits; one that states no size must fill it.
    return spec.prototype.buffer.from_array_like(values)


def _content_size(header: bytes) -> int | None:
    """Size that the header of a Zstandard frame states [bytes]; None: it states none, or is no such header."""
    if len(header) < 5 or header[:4] != b"\x28\xb5\x2f\xfd":
        return None
    single = header[4] >> 5 & 1
    start = 5 + (not single) + (0, 1, 2, 4)[header[4] & 3]
    length = (single, 2, 4, 8)[header[4] >> 6]
    return int.from_bytes(header[start : start + length], "little") + (256 if length == 2 else 0) if length else None


def _bound_codecs(codecs: Iterable[Any]) -> tuple[Any, ...]:
    """Replace zarr's Zstandard codec, in shards, too."""
    bounded = []
    for codec in codecs:
        if isinstance(codec, ZstdCodec):
            bounded.append(_BoundedZstd(level=codec.level, checksum=codec.checksum))
        elif isinstance(codec, ShardingCodec):
            bounded.append(dataclasses.replace(codec, codecs=_bound_codecs(codec.codecs)))
        else:
            bounded.append(codec)
    return tuple(bounded)


def _guard(name: str) -> Callable[..., Any]:
    """Method of `zarr.Array` that raises DatasetError for any fault but IndexError."""
    method = getattr(zarr.Array, name)

    @functools.wraps(method)
    def guarded(self: StoredArray, *arguments: Any, **options: Any) -> Any:
        try:
            return method(self, *arguments, **options)
        except (IndexError, DatasetError):
            raise
        except Exception as error:  # Codecs raise whatever their libraries raise.
            raise _unreadable(Path(str(self.store_path).removeprefix("file://")), error) from None

    return guarded


for _name in _SELECTIONS:
    setattr(StoredArray, _name, _guard(_name))
