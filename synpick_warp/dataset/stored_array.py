"""Zarr arrays of a trajectory store whose faults are one error class: damaged chunks, unknown codecs, files that cannot be read, and
compressed chunks that hold more than their place in the array (decompression bombs, CWE-409).

Imports zarr, so import it when an array is opened.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numcodecs.zstd
import numpy as np
import zarr
from zarr.codecs import ShardingCodec, ZstdCodec

from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.errors import DatasetError
from synpick_warp.system.processes.threads import ZARR_THREADS

zarr.config.set(ZARR_THREADS)

_SELECTIONS = (
    "get_basic_selection",
    "get_orthogonal_selection",
    "get_mask_selection",
    "get_coordinate_selection",
    "get_block_selection",
)
"""The methods of an array that read chunks; indexing calls one of them."""


class StoredArray(zarr.Array):
    """A read-only zarr array; reading raises DatasetError where zarr would raise an error of its own, except for a wrong index."""


def open_stored_array(folder: Path) -> StoredArray:
    """Open an array whose metadata has been checked.

    Raises:
        DatasetError: Zarr cannot open it.
    """
    try:
        opened = zarr.open_array(folder, mode="r").async_array
        metadata = dataclasses.replace(opened.metadata, codecs=_bound_codecs(opened.metadata.codecs))
        return StoredArray(type(opened)(metadata, opened.store_path, opened.config))
    except Exception as error:
        raise _dataset_error(folder, error) from None


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


_MAX_HEADER = 18
"""Largest header of a frame [bytes]."""


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
            raise _dataset_error(Path(str(self.store_path).removeprefix("file://")), error) from None

    return guarded


for _name in _SELECTIONS:
    setattr(StoredArray, _name, _guard(_name))


def _dataset_error(folder: Path, error: Exception) -> DatasetError:
    """DatasetError on an array that cannot be read, with the error's first 200 characters."""
    text = " ".join(str(error).split())[:200] or type(error).__name__
    return DatasetError(f"the array {folder} cannot be read: {text}; {ADVICE}")
