"""Declarations of device arrays: name, shape, type and unit in one place, allocated and measured from there."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import warp as wp

Arrays = TypeVar("Arrays")


@dataclass(frozen=True)
class ArraySpec:
    """Shape names, Warp type and unit of one device array."""

    shape: tuple[str, ...]
    dtype: Any
    unit: str


def device_array(*shape: str, dtype: Any, unit: str = "") -> Any:
    """Declare an array field of a dataclass; `allocate` makes it. Dimensions are names, resolved when allocated."""
    return field(metadata={"array": ArraySpec(shape, dtype, unit)})


def allocate(kind: type[Arrays], sizes: dict[str, int], device: wp.Device, only: Collection[str] | None = None) -> Arrays:
    """Make an instance of the dataclass `kind` whose arrays lie on `device`.

    Args:
        kind: A dataclass all of whose fields were declared by `device_array`.
        sizes: Extent of every named dimension.
        device: Where to put them.
        only: Fields to allocate, the others become None; None: all.
    """
    made: dict[str, wp.array | None] = {}
    for item in fields(kind):  # type: ignore[arg-type]
        if only is not None and item.name not in only:
            made[item.name] = None
            continue
        spec: ArraySpec = item.metadata["array"]
        shape = tuple(sizes[name] for name in spec.shape)
        made[item.name] = wp.zeros(shape, dtype=spec.dtype, device=device)
    return kind(**made)


def memory_table(kind: type, sizes: dict[str, int], only: Collection[str] | None = None) -> list[tuple[str, tuple[int, ...], str, int]]:
    """Rows (name, shape, unit, bytes) of the arrays that `allocate` would make, for given extents; nothing is allocated."""
    rows = []
    for item in fields(kind):
        if only is not None and item.name not in only:
            continue
        spec: ArraySpec = item.metadata["array"]
        shape = tuple(sizes[name] for name in spec.shape)
        rows.append((f"{kind.__name__}.{item.name}", shape, spec.unit, math.prod(shape) * wp.types.type_size_in_bytes(spec.dtype)))
    return rows
