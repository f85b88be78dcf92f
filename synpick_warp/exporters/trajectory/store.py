"""Zarr arrays with units and descriptions as attributes, and the groups of the store that all episodes share."""

import shutil
from collections.abc import Mapping
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from synpick_warp.configs.cell.cameras import WORLD
from synpick_warp.configs.schema import Trajectory
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.trajectory.arrays import (
    CAMERAS,
    CONSTANT_FILES,
    EPISODES,
    FORMAT,
    LABELS,
    OBJECTS,
    STORE,
    GroupSpec,
    TrajectoryArray,
)
from synpick_warp.scenes.types import FIRST_DISTRACTOR
from synpick_warp.system.processes.threads import ZARR_THREADS

zarr.config.set(ZARR_THREADS)


def add_group(parent: zarr.Group, name: str, doc: GroupSpec, attributes: Mapping[str, Any] | None = None) -> zarr.Group:
    """Create an empty group with its description, and the names of its coordinates if it has any, as attributes."""
    coordinates = {"coordinates": " ".join(doc.coordinates)} if doc.coordinates else {}
    return parent.create_group(name, attributes={"description": doc.description, **coordinates, **(attributes or {})})


def add_table(
    parent: zarr.Group, name: str, doc: GroupSpec, columns: Mapping[str, Any], level: int, attributes: Mapping[str, Any] | None = None
) -> None:
    """Create a group and write its arrays, `columns` by name, in the schema's types; `level`: compression level of zstd."""
    group = add_group(parent, name, doc, attributes)
    for column, spec in doc.arrays.items():
        add_array(group, column, spec, np.asarray(columns[column], spec.dtype), level)


def add_array(group: zarr.Group, name: str, spec: TrajectoryArray, data: np.ndarray, level: int, chunk: int = 0, shard: int = 0) -> None:
    """Write an array of values, of the schema's shape, which are sliced one shard at a time; `level`: compression level of zstd.

    `chunk`: rows per chunk (compressed together), 0: all; `shard`: rows per shard (file), a multiple of `chunk`, 0: it is not sharded.
    """
    attributes: dict[str, Any] = {"units": spec.unit, "description": spec.description}
    labels = {dim: list(LABELS[dim]) for dim in spec.dims if dim in LABELS}
    if labels:
        attributes["labels"] = labels
    if spec.codes:
        attributes["codes"] = list(spec.codes)
    dtype = np.dtype(spec.dtype)
    inner = tuple(max(1, extent) for extent in data.shape[1:])
    rows = chunk or max(1, len(data))
    array = group.create_array(
        name,
        shape=data.shape,
        dtype=dtype,
        chunks=(rows, *inner),
        shards=(shard, *inner) if shard else None,
        compressors=ZstdCodec(level=level),
        fill_value=np.nan if dtype.kind == "f" else 0,
        dimension_names=[dim if dim not in spec.dims[:index] else f"{dim}_2" for index, dim in enumerate(spec.dims)],
        attributes=attributes,
        # One file in the array's folder, instead of folders in folders.
        chunk_key_encoding={"name": "default", "separator": "."},
    )
    if not data.size:
        return
    for first in range(0, len(data), shard or len(data)):
        last = min(len(data), first + (shard or len(data)))
        array[first:last] = np.ascontiguousarray(data[first:last])


def chunk_layout(settings: Trajectory, ticks: int, rows_per_tick: int) -> tuple[int, int]:
    """Rows per chunk and per shard for an episode of `ticks` ticks; a shard is no larger than the array needs."""
    chunks = min(settings.shard_chunks, max(1, -(-ticks // settings.chunk_ticks)))
    chunk = settings.chunk_ticks * rows_per_tick
    return chunk, chunks * chunk


def write_constants(context: ExportContext) -> None:
    """Write the store's root, the groups of objects and cameras, and the group of episodes, replacing existing ones (CONSTANT_FILES)."""
    store, physics, level = context.out / STORE, context.settings.physics, context.settings.trajectory.level
    for folder in (store, store / EPISODES):
        folder.mkdir(exist_ok=True)
    for place in (context.out / name for name in CONSTANT_FILES):
        if place.is_dir():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)
    distractors = {
        "description": f"Objects without labels, by the object_id that they have in the arrays: {FIRST_DISTRACTOR} and below.",
        "names": {str(body.obj_id): body.name for body in context.catalog.distractors},
    }
    root = zarr.create_group(
        store,
        attributes={
            "description": "Physics of a synpick-warp data set. SI units; the world's origin is the centre of the"
            f" {context.settings.bins[0].noun}'s inner floor, z up. Episodes are in {EPISODES}, named by number.",
            "format": FORMAT,
            "seed": context.settings.bake.seed,
            "step": physics.step,
            "steps_per_tick": physics.steps_per_tick,
            "gravity": physics.gravity,
            "units": {"step": "s", "gravity": "m/s²"},
            "lights": [light.name for light in context.lights],
            **({"distractors": distractors} if context.catalog.distractors else {}),
        },
    )
    entries, cameras = context.catalog.entries, context.cameras
    columns = {name: [entry.obj_id if name == "object_id" else getattr(entry, name) for entry in entries] for name in OBJECTS.arrays}
    add_table(root, "objects", OBJECTS, columns, level, {"names": [entry.name for entry in entries]})
    known = {"fixed_to": [camera.fixed_to for camera in cameras], "distortion": [camera.distortion or None for camera in cameras]}
    usual = {"fixed_to": WORLD, "distortion": None}
    unusual = {name: values for name, values in known.items() if any(value != usual[name] for value in values)}
    columns = {name: [getattr(camera, name) for camera in cameras] for name in CAMERAS.arrays}
    add_table(root, "cameras", CAMERAS, columns, level, unusual)
    add_group(root, EPISODES, GroupSpec("One group an episode, named by its number with six digits."))
