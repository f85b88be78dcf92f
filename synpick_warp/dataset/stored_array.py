"""Zarr arrays of a trajectory store whose faults are one error class: damaged chunks, unknown codecs, files that cannot be read.

Imports zarr, so import it when an array is opened.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zarr

from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.errors import DatasetError
from synpick_warp.system.threads import ZARR_THREADS

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
        return StoredArray(zarr.open_array(folder, mode="r").async_array)
    except Exception as error:
        raise _dataset_error(folder, error) from None


def _guard(name: str) -> Callable[..., Any]:
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
    text = " ".join(str(error).split())[:200] or type(error).__name__
    return DatasetError(f"the array {folder} cannot be read: {text}; {ADVICE}")
