"""Trajectory store of a data set: zarr groups whose arrays are opened by name, lazily. Loads zarr when the first array is opened."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta, Struct

from synpick_warp.dataset.annotations import ADVICE, check_content
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.trajectory.arrays import CAMERAS, OBJECTS, GroupSpec
from synpick_warp.system.inputs.files import decode_json, read_file

if TYPE_CHECKING:
    import numpy as np
    import zarr

    from synpick_warp.scenes.types import Camera

GROUP_FILE = "zarr.json"
"""Metadata of a zarr group or array (zarr format 3)."""
MAX_METADATA = 2**24
"""Largest zarr.json [bytes]; those of a bake have some kilobytes."""
MAX_STEPS_PER_TICK = 1000
"""As in `physics.steps_per_tick`."""


@dataclass(frozen=True, eq=False)
class ObjectInfo:
    """Physical properties of a catalog object, in its frame."""

    object_id: int
    name: str
    mass: float
    """[kg]"""
    center_of_mass: np.ndarray
    """In the object's frame (3) float64 [m]."""
    inertia: np.ndarray
    """About the centre of mass, in the object's axes (3, 3) float64 [kg·m²]."""
    diameter: float
    """[m]"""
    volume: float
    """Volume of the collision shape [m³]."""


class _GroupMetadata(Struct):
    """Schema of the zarr.json of a group: its attributes."""

    zarr_format: Literal[3]
    node_type: Literal["group"]
    attributes: dict[str, Any]


class StoreAttributes(Struct):
    """Schema of the attributes of a trajectory store, as far as they are used: steps per tick, names of environment maps."""

    steps_per_tick: Annotated[int, Meta(ge=1, le=MAX_STEPS_PER_TICK)]
    lights: Annotated[list[str], Meta(max_length=2**16)] = []


class _ObjectsAttributes(Struct):
    """Schema of the attributes of the store's group of objects."""

    names: Annotated[list[str], Meta(max_length=2**16)]


@dataclass(frozen=True)
class GroupContext:
    """What the arrays of a group must agree with: sizes of dimensions, and files that the manifest lists; computed on access."""

    sizes: Callable[[], Mapping[str, int]] = dict
    """Sizes of dimensions by name, such as that of `tick`; dimensions that are not named may have any size."""
    files: Callable[[], Collection[Path]] = tuple
    """Files that the manifest lists; none if there is no manifest."""


class Arrays(Mapping[str, "zarr.Array"]):
    """Arrays of one zarr group by name, each opened on access: `arrays["pose"][10:20]` reads these rows only; empty without the folder."""

    def __init__(self, folder: Path, schema: GroupSpec, context: GroupContext | None = None) -> None:
        self._folder, self._schema, self._context = folder, schema, context or GroupContext()

    def __getitem__(self, name: str) -> zarr.Array:
        if "/" in name or name in (".", "..") or not (self._folder / name / GROUP_FILE).exists():
            raise KeyError(f"{name}; there are {', '.join(self) or 'no arrays'}")
        from synpick_warp.dataset.stored_array import open_array

        return open_array(self._folder / name, self._schema.arrays.get(name), self._context)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(path.parent.name for path in self._folder.glob(f"*/{GROUP_FILE}")))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return f"Arrays({', '.join(self)})"


def read_objects(store: Path, context: GroupContext | None = None) -> tuple[ObjectInfo, ...]:
    """Read the object table of a store, by catalog index."""
    folder = store / "objects"
    names = check_content(read_attributes(folder), _ObjectsAttributes, folder / GROUP_FILE).names
    files = (context or GroupContext()).files
    columns = _read_columns(Arrays(folder, OBJECTS, GroupContext(lambda: {"object": len(names)}, files)), OBJECTS, folder)
    rows = [{name: values[row] if values.ndim > 1 else values[row].item() for name, values in columns.items()} for row in range(len(names))]
    return tuple(ObjectInfo(name=name, **row) for name, row in zip(names, rows, strict=True))


def read_cameras(store: Path, count: int | None, context: GroupContext | None = None) -> tuple[Camera, ...]:
    """Read the camera table of a store, by camera index; `count` is the number of cameras, if it is known."""
    extents = {"width_height": 2, "row": 3, "column": 3} | ({} if count is None else {"camera": count})
    folder, files = store / "cameras", (context or GroupContext()).files
    columns = _read_columns(Arrays(folder, CAMERAS, GroupContext(lambda: extents, files)), CAMERAS, folder)
    rows = min(len(values) for values in columns.values())
    from synpick_warp.scenes.types import Camera

    sizes = columns.pop("resolution").tolist()
    return tuple(Camera(*sizes[row], **{name: values[row] for name, values in columns.items()}) for row in range(rows))


def _read_columns(arrays: Arrays, schema: GroupSpec, folder: Path) -> dict[str, np.ndarray]:
    if missing := sorted(set(schema.arrays) - set(arrays)):
        raise DatasetError(f"{folder} has no array {missing[0]}; {ADVICE}")
    return {name: read_array(arrays[name]) for name in schema.arrays}


def read_attributes(group: Path) -> dict[str, Any]:
    """Read a zarr group's attributes, without zarr. Raises DatasetError if the group's zarr.json is missing or damaged."""
    path = group / GROUP_FILE
    return decode_json(read_file(path, MAX_METADATA, DatasetError), _GroupMetadata, path, DatasetError, ADVICE).attributes


def read_array(array: zarr.Array) -> np.ndarray:
    """Read a whole array into memory."""
    import numpy as np

    return np.asarray(array[...])
