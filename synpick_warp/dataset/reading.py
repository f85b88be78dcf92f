"""Reads a data set's trajectories: lazily, as zarr arrays by name. Importing this loads neither simulator nor zarr."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.trajectory.arrays import CAMERAS, EPISODES, OBJECTS, STORE

if TYPE_CHECKING:
    import numpy as np
    import zarr

    from synpick_warp.configs.schema import Config

_GROUP_FILE = "zarr.json"
_CONFIG_FILE = "config.toml"


@dataclass(frozen=True, eq=False)
class ObjectInfo:
    """One object of the bake."""

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
    """Of the collision shape [m³]."""


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """One camera: x right, y down, z forward; pixel centres at + 0.5."""

    resolution: np.ndarray
    """Width and height (2) int32 [px]."""
    matrix: np.ndarray
    """K (3, 3) float64 [px]."""
    rotation: np.ndarray
    """World to camera (3, 3) float64."""
    translation: np.ndarray
    """World to camera (3) float64 [m]."""


class Arrays(Mapping[str, "zarr.Array"]):
    """Arrays of one group by name, each opened when it is asked for: `arrays["pose"][10:20]` reads these rows alone."""

    def __init__(self, folder: Path) -> None:
        """
        Args:
            folder: The group, which exists.
        """
        self._folder = folder

    def __getitem__(self, name: str) -> zarr.Array:
        if "/" in name or not (self._folder / name / _GROUP_FILE).is_file():
            raise KeyError(f"{name}; there are {', '.join(self) or 'no arrays'}")
        import zarr

        return zarr.open_array(self._folder / name, mode="r")

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(path.parent.name for path in self._folder.glob(f"*/{_GROUP_FILE}")))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return f"Arrays({', '.join(self)})"


class Episode:
    """One episode. `attributes` say how it ended; `ticks`, `steps`, `arrangement` have arrays; `attempts` are records."""

    def __init__(self, folder: Path) -> None:
        """
        Args:
            folder: Its group, which exists.
        """
        self._folder = folder
        self.number = int(folder.name)

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """What the episode is: mode, ending, frames, light, ..."""
        return _attributes(self._folder)

    @property
    def ticks(self) -> Arrays:
        """One row a frame."""
        return Arrays(self._folder / "ticks")

    @property
    def steps(self) -> Arrays:
        """One row a step of physics; empty if steps were not recorded."""
        return Arrays(self._folder / "steps")

    @property
    def arrangement(self) -> Arrays:
        """Which objects, and how they were dropped."""
        return Arrays(self._folder / "arrangement")

    @property
    def attempt_arrays(self) -> Arrays:
        """What `attempts` say, as arrays with one row an attempt."""
        return Arrays(self._folder / "attempts")

    @cached_property
    def attempts(self) -> tuple[dict[str, Any], ...]:
        """Every attempt to pick, as a line of attempts.jsonl has it."""
        return tuple(json.loads(line) for line in _values(self.attempt_arrays["record"]).tobytes().splitlines())

    def __len__(self) -> int:
        """Frames."""
        return int(self.attributes["frames"])

    def __repr__(self) -> str:
        attributes = self.attributes
        return f"Episode({self.number}: {attributes['frames']} frames, {attributes['ending']})"


class DataSet(Mapping[int, Episode]):
    """The episodes of a data set by number, and what they share. Nothing is read before it is asked for."""

    def __init__(self, folder: Path) -> None:
        """
        Args:
            folder: The data set, which has a store.
        """
        self.folder = folder
        self._store = folder / STORE

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """Seed, step, steps a tick, names of light maps, ..."""
        return _attributes(self._store)

    @cached_property
    def config(self) -> Config:
        """All settings of the bake.

        Raises:
            ConfigError: They are not there, or not as this version has them.
        """
        from synpick_warp.configs.load import load_config

        return load_config(str(self.folder / _CONFIG_FILE), {})

    @cached_property
    def objects(self) -> tuple[ObjectInfo, ...]:
        """The object table."""
        names = _attributes(self._store / "objects")["names"]
        columns = {name: _values(array) for name, array in Arrays(self._store / "objects").items() if name in OBJECTS.arrays}
        rows = [{name: values[row] for name, values in columns.items()} for row in range(len(names))]
        return tuple(
            ObjectInfo(name=name, **{key: _plain(value) for key, value in row.items()}) for name, row in zip(names, rows, strict=True)
        )

    @cached_property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """The cameras, in the order of the scenes."""
        columns = {name: _values(array) for name, array in Arrays(self._store / "cameras").items() if name in CAMERAS.arrays}
        return tuple(CameraInfo(**{name: values[row] for name, values in columns.items()}) for row in range(len(columns["matrix"])))

    def __getitem__(self, number: int) -> Episode:
        folder = self._store / EPISODES / f"{number:06d}"
        if not (folder / _GROUP_FILE).is_file():
            raise KeyError(f"{self.folder} has no episode {number}")
        return Episode(folder)

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(int(path.name) for path in (self._store / EPISODES).iterdir() if path.is_dir()))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return f"DataSet({str(self.folder)!r}, {len(self)} episodes)"


def open_data_set(folder: Path | str) -> DataSet:
    """A data set with trajectories; reads nothing yet.

    Args:
        folder: What a bake with the format zarr wrote, or is still writing.

    Raises:
        DatasetError: There are no trajectories.
    """
    folder = Path(folder)
    if not (folder / STORE / EPISODES / _GROUP_FILE).is_file():
        raise DatasetError(f"{folder} has no {STORE}; bake with --formats zarr, which may stand beside others, as in bop,zarr")
    return DataSet(folder)


def _attributes(group: Path) -> dict[str, Any]:
    return json.loads((group / _GROUP_FILE).read_bytes())["attributes"]


def _values(array: zarr.Array) -> np.ndarray:
    """All of an array."""
    import numpy as np

    return np.asarray(array[...])


def _plain(value: Any) -> Any:
    """A number of NumPy as one of Python; arrays as they are."""
    return value.item() if value.ndim == 0 else value
