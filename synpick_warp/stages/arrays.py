"""Declarations of device arrays: name, dimensions, type and unit in one place, from which arrays are allocated and their memory counted.

Two forms: a dataclass whose fields are declared by `device_array`, for the host; and `struct_arrays`, for the members of a Warp struct,
whose types and numbers of dimensions come from the struct itself.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import warp as wp

Arrays = TypeVar("Arrays")


@dataclass(frozen=True)
class ArraySpec:
    """Specification of one device array: dimension names, Warp type and unit."""

    shape: tuple[str, ...]
    dtype: Any
    unit: str


def device_array(*shape: str, dtype: Any, unit: str = "") -> Any:
    """Declare an array field of a dataclass; `allocate` allocates it. Dimensions are names that get their extents there."""
    return field(metadata={"array": ArraySpec(shape, dtype, unit)})


@dataclass(frozen=True, eq=False)
class StructArrays:
    """Specifications of the arrays of a Warp struct, by member; see `struct_arrays`."""

    struct: Any
    specs: Mapping[str, ArraySpec]

    @property
    def __name__(self) -> str:
        return self.struct.cls.__name__


def struct_arrays(struct: Any, *shape: str, units: Mapping[str, str] | None = None, **shapes: tuple[str, ...]) -> StructArrays:
    """Declare the arrays of a Warp struct; `allocate_struct` allocates them.

    Args:
        struct: Class decorated by `wp.struct`. Its array annotations give types and numbers of dimensions; other members stay 0.
        shape: Names of the dimensions of all its arrays ...
        shapes: ... but for these, by the name of the member.
        units: Unit by the name of the member.

    Raises:
        TypeError: A member has another number of dimensions than the names given for it, or a name belongs to no array.
    """
    types = {name: member.type for name, member in struct.vars.items() if hasattr(member.type, "ndim")}
    if unknown := (set(shapes) | set(units or {})) - set(types):
        raise TypeError(f"{struct.cls.__name__} has no array {sorted(unknown)[0]}")
    specs = {name: ArraySpec(shapes.get(name, shape), kind.dtype, (units or {}).get(name, "")) for name, kind in types.items()}
    for name, spec in specs.items():
        if len(spec.shape) != types[name].ndim:
            raise TypeError(
                f"{struct.cls.__name__}.{name} has {types[name].ndim} dimensions, not {len(spec.shape)}: {', '.join(spec.shape)}"
            )
    return StructArrays(struct, specs)


def allocate(kind: type[Arrays], sizes: dict[str, int], device: wp.Device, only: Collection[str] | None = None) -> Arrays:
    """Instance of the dataclass `kind` with zeroed arrays on `device`.

    Args:
        kind: A dataclass all of whose fields were declared by `device_array`.
        sizes: Extent of every named dimension.
        device: Where to allocate.
        only: Fields to allocate, the others become None; None: all.
    """
    names = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    arrays = _allocate_arrays(kind, sizes, device, only)
    return kind(**{name: arrays.get(name) for name in names})


def allocate_struct(declaration: StructArrays, sizes: dict[str, int], device: wp.Device) -> Any:
    """Instance of a Warp struct with zeroed arrays on `device`; `sizes` has the extent of every named dimension."""
    result = declaration.struct()
    for name, array in _allocate_arrays(declaration, sizes, device, None).items():
        setattr(result, name, array)
    return result


def memory_table(
    kind: type | StructArrays, sizes: dict[str, int], only: Collection[str] | None = None
) -> list[tuple[str, tuple[int, ...], str, int]]:
    """Rows (name, shape, unit, bytes) of the arrays that `allocate` or `allocate_struct` would allocate; nothing is allocated."""
    rows = []
    for name, spec in _specs(kind, only).items():
        shape = tuple(sizes[dimension] for dimension in spec.shape)
        rows.append((f"{kind.__name__}.{name}", shape, spec.unit, math.prod(shape) * wp.types.type_size_in_bytes(spec.dtype)))
    return rows


def _specs(kind: Any, only: Collection[str] | None) -> dict[str, ArraySpec]:
    """Specifications of the arrays of a class or struct by name, all or `only` some."""
    specs = kind.specs if isinstance(kind, StructArrays) else {item.name: item.metadata["array"] for item in fields(kind)}
    return {name: spec for name, spec in specs.items() if only is None or name in only}


def _allocate_arrays(kind: Any, sizes: dict[str, int], device: wp.Device, only: Collection[str] | None) -> dict[str, wp.array]:
    """Allocate the arrays of a class or struct by name, zero; `sizes` gives the extents of their dimensions."""
    return {
        name: wp.zeros(tuple(sizes[dimension] for dimension in spec.shape), dtype=spec.dtype, device=device)
        for name, spec in _specs(kind, only).items()
    }
