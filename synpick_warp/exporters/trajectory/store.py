"""Zarr arrays with names, units and meaning, and what a data set's store says once."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from synpick_warp.configs.schema import Config, Trajectory
from synpick_warp.exporters.trajectory.arrays import CAMERAS, CONSTANTS, EPISODES, FORMAT, LABELS, OBJECTS, GroupDoc, Quantity
from synpick_warp.scenes.types import Camera, Catalog, EnvironmentMap

# The writers are the parallelism.
zarr.config.set({"async.concurrency": 1, "threading.max_workers": 1})


def add_group(parent: zarr.Group, name: str, doc: GroupDoc, attributes: Mapping[str, Any] | None = None) -> zarr.Group:
    """Make an empty group that says what it is."""
    return parent.create_group(name, attributes={"description": doc.description, **(attributes or {})})


def add_array(group: zarr.Group, name: str, quantity: Quantity, data: np.ndarray, level: int, chunk: int = 0, shard: int = 0) -> None:
    """Write an array.

    Args:
        group: Where.
        name: Its name there.
        quantity: What it is.
        data: Its values, of the quantity's shape; read one file's worth at a time.
        level: Of zstd.
        chunk: Rows that are compressed at once; 0: all.
        shard: Rows in a file, a multiple of `chunk`; 0: the array is not sharded.
    """
    attributes: dict[str, Any] = {"unit": quantity.unit, "description": quantity.description}
    labels = {dim: list(LABELS[dim]) for dim in quantity.dims if dim in LABELS}
    if labels:
        attributes["labels"] = labels
    if quantity.codes:
        attributes["codes"] = list(quantity.codes)
    kind = np.dtype(quantity.dtype)
    inner = tuple(max(1, extent) for extent in data.shape[1:])
    rows = chunk or max(1, len(data))
    array = group.create_array(
        name,
        shape=data.shape,
        dtype=kind,
        chunks=(rows, *inner),
        shards=(shard, *inner) if shard else None,
        compressors=ZstdCodec(level=level),
        fill_value=np.nan if kind.kind == "f" else 0,
        dimension_names=_distinct(quantity.dims),
        attributes=attributes,
        # One file in the array's folder, instead of folders in folders.
        chunk_key_encoding={"name": "default", "separator": "."},
    )
    if not data.size:
        return
    for first in range(0, len(data), shard or len(data)):
        last = min(len(data), first + (shard or len(data)))
        array[first:last] = np.ascontiguousarray(data[first:last])


def _distinct(dims: tuple[str, ...]) -> tuple[str, ...]:
    """Names of dimensions, none twice: a matrix has an axis and an axis_2."""
    return tuple(name if name not in dims[:place] else f"{name}_2" for place, name in enumerate(dims))


def shard_rows(settings: Trajectory, ticks: int, rows_per_tick: int) -> tuple[int, int]:
    """Rows in a chunk and in a file of an episode of so many ticks: a file is no larger than the array."""
    chunks = min(settings.shard_chunks, max(1, -(-ticks // settings.chunk_ticks)))
    chunk = settings.chunk_ticks * rows_per_tick
    return chunk, chunks * chunk


def write_constants(
    store: Path, config: Config, catalog: Catalog, cameras: tuple[Camera, ...], lights: tuple[EnvironmentMap, ...]
) -> list[Path]:
    """Write what all episodes share, in place of what is there of it.

    Args:
        store: A folder that exists, and in it one for the episodes.
        config: Settings.
        catalog: The objects.
        cameras: The cameras.
        lights: The light maps.

    Returns:
        Files and folders that were written.
    """
    physics = config.physics
    places = [store / "zarr.json", *(store / name for name in CONSTANTS), store / EPISODES / "zarr.json"]
    for place in places:
        if place.is_dir():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)
    root = zarr.create_group(
        store,
        attributes={
            "description": "Physics of a synpick-warp data set. SI units; the world's origin is the centre of the tote's inner floor, z up."
            f" Episodes are in {EPISODES}, named by number.",
            "format": FORMAT,
            "seed": config.bake.seed,
            "step": physics.step,
            "steps_per_tick": physics.steps_per_tick,
            "gravity": physics.gravity,
            "units": {"step": "s", "gravity": "m/s²"},
            "lights": [light.name for light in lights],
        },
    )
    entries = catalog.entries
    objects = add_group(root, "objects", OBJECTS, {"names": [entry.name for entry in entries]})
    for name, quantity in OBJECTS.arrays.items():
        values = [entry.obj_id if name == "object_id" else getattr(entry, name) for entry in entries]
        add_array(objects, name, quantity, np.array(values, quantity.dtype), config.trajectory.level)
    group = add_group(root, "cameras", CAMERAS)
    for name, quantity in CAMERAS.arrays.items():
        values = [(camera.width, camera.height) if name == "resolution" else getattr(camera, name) for camera in cameras]
        add_array(group, name, quantity, np.array(values, quantity.dtype), config.trajectory.level)
    add_group(root, EPISODES, GroupDoc("One group an episode, named by its number with six digits."))
    return places
