"""Zarr arrays of a trajectory store: metadata are checked before a chunk is read, and all faults are one error class.

Metadata may be edited or damaged, and memory, loops and code follow from them: so shape, type, chunks and codecs are compared with the
schema and with what is stored. Compressed chunks that hold more than their place in the array (decompression bombs, CWE-409), other codecs
and files that cannot be read are a DatasetError.

Imports zarr, so import it when an array is opened.
"""

import asyncio
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numcodecs.zstd
import numpy as np
import zarr
from zarr.codecs import BytesCodec, Crc32cCodec, ShardingCodec, ZstdCodec

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.trajectory import GROUP_FILE, MAX_METADATA, MAX_STEPS_PER_TICK, GroupContext
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.trajectory.arrays import LABELS, TrajectoryArray
from synpick_warp.system.hardware.cores import ZARR_THREADS
from synpick_warp.system.inputs.files import check_regular_file, describe_bytes

zarr.config.set(ZARR_THREADS)

_KINDS = "biuf"
"""Kinds of NumPy's types that are read: truth values and numbers."""
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


class StoredArray(zarr.Array):
    """A read-only zarr array; reading raises DatasetError where zarr would raise an error of its own, except for a wrong index."""


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


for _selection in ("basic", "orthogonal", "mask", "coordinate", "block"):  # Indexing calls one of these methods, which read chunks.
    setattr(StoredArray, f"get_{_selection}_selection", _guard(f"get_{_selection}_selection"))


def open_array(folder: Path, spec: TrajectoryArray | None, context: GroupContext) -> StoredArray:
    """Open an array of a schema (None: it is none of ours), which must agree with `context`.

    Raises DatasetError if its metadata does not fit, a file is missing or too large, or zarr cannot open it.
    """
    check_regular_file(folder / GROUP_FILE, MAX_METADATA, DatasetError)
    try:
        opened = zarr.open_array(folder, mode="r", zarr_format=3).async_array
        bounded = dataclasses.replace(opened.metadata, codecs=_bound_codecs(opened.metadata.codecs))
        levels = _chunk_shapes(opened.metadata.chunk_grid, opened.metadata.codecs)
    except Exception as error:
        raise _unreadable(folder, error) from None
    _check_shape(folder, opened.shape, opened.dtype, spec, context.sizes())
    has_steps = spec is None or spec.dims[0] == "step"
    _check_chunks(folder, opened.shape, levels, _MAX_CHUNK_TICKS * (MAX_STEPS_PER_TICK if has_steps else 1))
    chunk, inner = math.prod(levels[0]), math.prod(levels[0]) // max(1, math.prod(levels[-1]))
    # Data that zstd cannot compress grow by less than a hundredth; an index has 16 bytes a chunk.
    _check_files(folder, chunk * opened.dtype.itemsize * 101 // 100 + 1024 * (inner + 1), context.files())
    return StoredArray(type(opened)(bounded, opened.store_path, opened.config))


def _check_shape(folder: Path, shape: tuple[int, ...], dtype: np.dtype, spec: TrajectoryArray | None, sizes: Mapping[str, int]) -> None:
    """Compare type and shape with the schema (None: any) and the known `sizes` of dimensions; those that nothing determines with the
    largest possible, or with what is stored."""
    if dtype.kind not in _KINDS:
        raise _fault(folder, f"is of type {dtype}; allowed: numbers and truth values")
    names = tuple(f"dimension {axis}" for axis in range(len(shape))) if spec is None else spec.dims
    expected = [len(LABELS[name]) if name in LABELS else sizes.get(name) for name in names]
    wanted = dtype if spec is None else np.dtype(spec.dtype)
    if len(shape) != len(names) or dtype != wanted or any(size not in (None, n) for size, n in zip(expected, shape, strict=True)):
        known = " x ".join(name if size is None else str(size) for name, size in zip(names, expected, strict=True))
        raise _fault(folder, f"is {dtype} of shape {' x '.join(map(str, shape))}; expected: {wanted} of shape {known}")
    free = {name: given for name, size, given in zip(names, expected, shape, strict=True) if size is None}
    most = {"instance": MAX_INSTANCES, "lift_tick": sizes.get("tick")}
    size, stored = math.prod(shape) * dtype.itemsize, _stored_bytes(folder)
    exceeds = any(given > (most.get(name) or given) for name, given in free.items())
    if exceeds or size > _MAX_ARRAY or (free.keys() - most.keys() and size > _SMALL + _MAX_RATIO * stored):
        there = " and ".join(f"{given:,} as {name}" for name, given in free.items()) or describe_bytes(size)
        raise _fault(folder, f"states {there}, more than its {describe_bytes(stored)} can hold")
    if spec is not None and spec.dims[0] == "step":
        times = folder.parent / "time"
        stored = _stored_bytes(times) if times.is_dir() else 0
        if shape[0] > _FEW_STEPS + _STEPS_PER_BYTE * stored:
            raise _fault(folder, f"states {shape[0]:,} steps, more than the {describe_bytes(stored)} of their times can hold")


def _stored_bytes(folder: Path) -> int:
    """Size of the files of an array [bytes]."""
    return sum(entry.stat(follow_symlinks=False).st_size for entry in os.scandir(folder))


def _chunk_shapes(grid: Any, codecs: Iterable[Any]) -> list[Sequence[int]]:
    """Shapes of the chunks, from the files down to what is compressed together."""
    inner = [_chunk_shapes(codec, codec.codecs) for codec in codecs if isinstance(codec, ShardingCodec)]
    return [grid.chunk_shape, *(inner[0] if inner else ())]


def _check_chunks(folder: Path, shape: Sequence[int], levels: Sequence[Sequence[int]], rows: int) -> None:
    """Raise DatasetError if chunks, of shapes from the files down, are larger than the array, but for the end of the last one, or more than
    one a row and _FEW_CHUNKS; `rows`: most rows of a chunk in an array that has less."""
    extents = [max(1, size) for size in shape]
    if any(len(level) != len(extents) or min(level, default=1) < 1 for level in levels):
        raise _fault(folder, "has chunks of another shape")
    if not extents:
        return
    innermost = levels[-1]
    padded, most = [extents[0] + innermost[0], *extents[1:]], [max(rows, extents[0]), *extents[1:]]
    for level, limits in [*((level, padded) for level in levels[:-1]), (innermost, most)]:
        if any(size > limit for size, limit in zip(level, limits, strict=True)):
            there = f"has chunks of {' x '.join(map(str, level))}"
            raise _fault(folder, f"{there}, larger than its {' x '.join(map(str, shape))}")
    count = math.prod(-(-size // part) for size, part in zip(extents, innermost, strict=True))
    if count > extents[0] + _FEW_CHUNKS:
        raise _fault(folder, f"has {count:,} chunks for {shape[0]:,} rows; allowed: one a row")


def _check_files(folder: Path, largest: int, listed: Collection[Path]) -> None:
    """Check that the chunk files that the manifest lists exist, and that all are regular files of up to `largest` bytes.

    Zarr reads a missing chunk file as fill values, and writes no file for a chunk of these: only the manifest shows that one was lost.
    """
    present = {folder / entry.name for entry in os.scandir(folder)}
    for path in sorted(path for path in listed if path.parent == folder and path not in present):
        raise DatasetError(f"there is no {path}, which the manifest lists; {ADVICE}")
    for path in present - {folder / GROUP_FILE}:
        check_regular_file(path, largest, DatasetError)


def _fault(folder: Path, text: str) -> DatasetError:
    """Error about an array."""
    return DatasetError(f"the array {folder} {text}; {ADVICE}")


def _unreadable(folder: Path, error: Exception) -> DatasetError:
    """Error about an array that cannot be read, with the first 200 characters of the cause."""
    return _fault(folder, f"cannot be read: {' '.join(str(error).split())[:200] or type(error).__name__}")


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
    """Replace zarr's Zstandard codec, in shards, too; raises ValueError for codecs of other kinds, which decompress without bounds."""
    bounded = []
    for codec in codecs:
        if isinstance(codec, ZstdCodec):
            bounded.append(_BoundedZstd(level=codec.level, checksum=codec.checksum))
        elif isinstance(codec, ShardingCodec) and all(isinstance(index, BytesCodec | Crc32cCodec) for index in codec.index_codecs):
            bounded.append(dataclasses.replace(codec, codecs=_bound_codecs(codec.codecs)))
        elif isinstance(codec, BytesCodec | Crc32cCodec):
            bounded.append(codec)
        else:
            raise ValueError(f"the codec {codec.to_dict()['name']} is not allowed here")
    return tuple(bounded)
