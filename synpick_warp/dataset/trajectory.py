"""Trajectory store of a data set: zarr groups whose arrays are opened by name, lazily. Loads zarr when the first array is opened."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synpick_warp.exporters.trajectory.arrays import CAMERAS, OBJECTS

if TYPE_CHECKING:
    import numpy as np
    import zarr

GROUP_FILE = "zarr.json"
"""Metadata of a zarr group or array (zarr format 3)."""


@dataclass(frozen=True, eq=False)
class ObjectInfo:
    """Physical properties of one object of the catalog."""

    object_id: int
    """BOP object id."""
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


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """Pinhole camera in OpenCV's convention: x right, y down, z forward; pixel centres at + 0.5."""

    resolution: np.ndarray
    """Width and height (2) int32 [px]."""
    matrix: np.ndarray
    """K (3, 3) float64 [px]."""
    rotation: np.ndarray
    """World to camera (3, 3) float64."""
    translation: np.ndarray
    """World to camera (3) float64 [m]."""


class Arrays(Mapping[str, "zarr.Array"]):
    """Arrays of one zarr group by name, each opened on access: `arrays["pose"][10:20]` reads these rows only."""

    def __init__(self, folder: Path) -> None:
        """
        Args:
            folder: Folder of the group; if there is none, the mapping is empty.
        """
        self._folder = folder

    def __getitem__(self, name: str) -> zarr.Array:
        if "/" in name or not (self._folder / name / GROUP_FILE).is_file():
            raise KeyError(f"{name}; there are {', '.join(self) or 'no arrays'}")
        import zarr

        return zarr.open_array(self._folder / name, mode="r")

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(path.parent.name for path in self._folder.glob(f"*/{GROUP_FILE}")))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return f"Arrays({', '.join(self)})"


def read_objects(store: Path) -> tuple[ObjectInfo, ...]:
    """Read the object table of a store, by catalog index."""
    names = read_attributes(store / "objects")["names"]
    columns = {name: read_array(array) for name, array in Arrays(store / "objects").items() if name in OBJECTS.arrays}
    rows = [{name: _to_python(values[row]) for name, values in columns.items()} for row in range(len(names))]
    return tuple(ObjectInfo(name=name, **row) for name, row in zip(names, rows, strict=True))


def read_cameras(store: Path) -> tuple[CameraInfo, ...]:
    """Read the camera table of a store, by camera index."""
    columns = {name: read_array(array) for name, array in Arrays(store / "cameras").items() if name in CAMERAS.arrays}
    return tuple(CameraInfo(**{name: values[row] for name, values in columns.items()}) for row in range(len(columns["matrix"])))


def read_attributes(group: Path) -> dict[str, Any]:
    """Read a zarr group's attributes, without zarr."""
    return json.loads((group / GROUP_FILE).read_bytes())["attributes"]


def read_array(array: zarr.Array) -> np.ndarray:
    """Read a whole array."""
    import numpy as np

    return np.asarray(array[...])


def _to_python(value: Any) -> Any:
    """Convert a NumPy scalar to a Python number; arrays stay."""
    return value.item() if value.ndim == 0 else value
