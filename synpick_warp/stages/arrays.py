"""Declarations of device arrays: name, dimensions, type and unit in one place, from which arrays are allocated and their memory counted.

Two forms: a dataclass whose fields are declared by `device_array`, for the host; and `struct_arrays`, for the members of a Warp struct,
whose types and numbers of dimensions come from the struct itself. `array_group` makes the first of the second, for the host and kernels.

In a dry run (`dry_run`) the same calls allocate nothing: they return stand-ins and list them, by which the memory plan counts what the
constructors of the stages would allocate.
"""

import contextlib
import math
from collections.abc import Collection, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, make_dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any, ClassVar, TypeVar

import numpy as np
import warp as wp

WORD_BITS = 32
"""Instances of a word of a bit set; see `kernels.bitsets`."""
Arrays = TypeVar("Arrays")
Row = tuple[str, tuple[int, ...], str, int]
"""Name, shape, unit and size [bytes] of an array."""


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
    """Declare the arrays of a Warp struct, whose array annotations give types and numbers of dimensions; other members stay 0.
    `allocate_struct` allocates them.

    `shape` are the names of the dimensions of all its arrays but those that `shapes` names by member; `units` are by member, too. Raises
    TypeError if a member has another number of dimensions than the names given for it, or a name belongs to no array."""
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


class ArrayGroup:
    """Group of device arrays that kernels take as one struct (bundle): a dataclass with a field for each member of it."""

    struct: ClassVar[Any]
    """The class decorated by `wp.struct`."""

    @cached_property
    def bundle(self) -> Any:
        """The struct with these arrays."""
        return bundle(self.struct, self)


def bundle(struct: Any, *sources: object) -> Any:
    """Instance of a Warp struct whose members are the sources' attributes of these names, each of the first that has one; raises TypeError
    if no source has a member."""
    result = struct()
    for name in struct.vars:
        owner = next((source for source in sources if hasattr(source, name)), None)
        if owner is None:
            raise TypeError(f"no source has {struct.cls.__name__}.{name}")
        setattr(result, name, getattr(owner, name))
    return result


def array_group(struct: Any, *shape: str, units: Mapping[str, str] | None = None, **shapes: tuple[str, ...]) -> Any:
    """Base of an `ArrayGroup` with the arrays of a Warp struct; arguments as of `struct_arrays`."""
    specs = struct_arrays(struct, *shape, units=units, **shapes).specs
    declared = [(name, wp.array, field(metadata={"array": spec})) for name, spec in specs.items()]
    return make_dataclass(struct.cls.__name__, declared, bases=(ArrayGroup,), namespace={"struct": struct}, frozen=True, eq=False)


@dataclass(frozen=True, eq=False)
class DryArray:
    """Stand-in for an array in a dry run: what is asked of arrays before kernels run."""

    name: str
    spec: ArraySpec
    shape: tuple[int, ...]
    device: wp.Device

    @property
    def dtype(self) -> Any:
        """Warp type."""
        return self.spec.dtype

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def row(self) -> Row:
        """Row of a memory table."""
        return (self.name, self.shape, self.spec.unit, self.size * wp.types.type_size_in_bytes(self.dtype))

    def fill_(self, value: Any) -> None:
        """Nothing is filled."""

    assign = fill_


_dry: ContextVar[list[DryArray] | None] = ContextVar("dry", default=None)
"""Stand-ins of the dry run of this thread; None: arrays are allocated."""


@contextlib.contextmanager
def dry_run() -> Iterator[list[DryArray]]:
    """Dry run: within, `allocate`, `allocate_struct` and `allocate_like` allocate nothing in this thread; the list gets their stand-ins."""
    arrays: list[DryArray] = []
    token = _dry.set(arrays)
    try:
        yield arrays
    finally:
        _dry.reset(token)


def _zeros(name: str, spec: ArraySpec, shape: tuple[int, ...], device: wp.Device, pinned: bool = False) -> Any:
    """Zeroed array; its stand-in in a dry run."""
    arrays = _dry.get()
    if arrays is None:
        return wp.zeros(shape, dtype=spec.dtype, device=device, pinned=pinned)
    arrays.append(DryArray(name, spec, shape, device))
    return arrays[-1]


def allocate(kind: type[Arrays], sizes: dict[str, int], device: wp.Device, only: Collection[str] | None = None) -> Arrays:
    """Instance of the dataclass `kind`, all of whose fields were declared by `device_array`, with zeroed arrays on `device`. `sizes`:
    extent of every named dimension; `only`: fields to allocate, the others become None; None: all."""
    specs = {item.name: item.metadata["array"] for item in fields(kind)}  # type: ignore[arg-type]
    made = _allocate(kind.__name__, {name: spec for name, spec in specs.items() if only is None or name in only}, sizes, device)
    return kind(**{name: made.get(name) for name in specs})


def allocate_struct(declaration: StructArrays, sizes: dict[str, int], device: wp.Device) -> Any:
    """Instance of a Warp struct with zeroed arrays on `device`; `sizes` has the extent of every named dimension."""
    result = declaration.struct() if _dry.get() is None else SimpleNamespace()
    for name, array in _allocate(declaration.__name__, declaration.specs, sizes, device).items():
        setattr(result, name, array)
    return result


def allocate_like(array: wp.array, length: int, device: wp.Device, pinned: bool = False) -> wp.array:
    """Zeroed array on `device` like another but for the length of its first dimension; `pinned`: in pinned memory of the host."""
    name, spec = (array.name, array.spec) if isinstance(array, DryArray) else ("", ArraySpec((), array.dtype, ""))
    return _zeros(name, spec, (length, *array.shape[1:]), device, pinned)


def _allocate(owner: str, specs: Mapping[str, ArraySpec], sizes: dict[str, int], device: wp.Device) -> dict[str, Any]:
    return {
        name: _zeros(f"{owner}.{name}", spec, tuple(sizes[dimension] for dimension in spec.shape), device) for name, spec in specs.items()
    }


def count_words(instances: int) -> int:
    """Words of a bit set of instances."""
    return -(-instances // WORD_BITS)


def unpack_words(words: np.ndarray, instances: int) -> np.ndarray:
    """Unpack bit sets (..., word) uint32: 1 for each member (..., instance) uint8."""
    octets = np.ascontiguousarray(words, "<u4").view(np.uint8)
    return np.unpackbits(octets, axis=-1, bitorder="little")[..., :instances]
