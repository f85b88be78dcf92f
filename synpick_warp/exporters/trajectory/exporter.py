"""Exporter of physics trajectories to zarr: poses, velocities, forces and attempts, one group per episode.

Its writer tasks spool records of fixed size, one per tick, and make the groups with units and descriptions.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from synpick_warp.codes import Ending, Mode, Outcome
from synpick_warp.configs.cell.cameras import WORLD
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Trajectory
from synpick_warp.exporters.base import EpisodeExporter, ExportContext, SharedFiles, StagedEpisode
from synpick_warp.exporters.trajectory import arrays as schema
from synpick_warp.exporters.writing.files import output_errors, sync_file, sync_folder
from synpick_warp.exporters.writing.pool import WriteTask
from synpick_warp.scenes.types import FIRST_DISTRACTOR
from synpick_warp.system.hardware.cores import ZARR_THREADS
from synpick_warp.system.processes.shared_memory import shared_bytes
from synpick_warp.views.frames import EpisodeEnd, TickBatch

zarr.config.set(ZARR_THREADS)


def add_group(parent: zarr.Group, name: str, doc: schema.GroupSpec, attributes: Mapping[str, Any] | None = None) -> zarr.Group:
    """Create an empty group with its description, and the names of its coordinates if it has any, as attributes."""
    coordinates = {"coordinates": " ".join(doc.coordinates)} if doc.coordinates else {}
    return parent.create_group(name, attributes={"description": doc.description, **coordinates, **(attributes or {})})


def add_table(
    parent: zarr.Group,
    name: str,
    doc: schema.GroupSpec,
    columns: Mapping[str, Any],
    level: int,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Create a group and write its arrays, `columns` by name, in the schema's types; `level`: compression level of zstd."""
    group = add_group(parent, name, doc, attributes)
    for column, spec in doc.arrays.items():
        add_array(group, column, spec, np.asarray(columns[column], spec.dtype), level)


def add_array(
    group: zarr.Group, name: str, spec: schema.TrajectoryArray, data: np.ndarray, level: int, chunk: int = 0, shard: int = 0
) -> None:
    """Write an array of values, of the schema's shape, which are sliced one shard at a time; `level`: compression level of zstd.

    `chunk`: rows per chunk (compressed together), 0: all; `shard`: rows per shard (file), a multiple of `chunk`, 0: it is not sharded.
    """
    attributes: dict[str, Any] = {"units": spec.unit, "description": spec.description}
    labels = {dim: list(schema.LABELS[dim]) for dim in spec.dims if dim in schema.LABELS}
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
    store, physics, level = context.out / schema.STORE, context.settings.physics, context.settings.trajectory.level
    for folder in (store, store / schema.EPISODES):
        folder.mkdir(exist_ok=True)
    for place in (context.out / name for name in schema.CONSTANT_FILES):
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
            f" {context.settings.bins[0].noun}'s inner floor, z up. Episodes are in {schema.EPISODES}, named by number.",
            "format": schema.FORMAT,
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
    columns = {name: [entry.obj_id if name == "object_id" else getattr(entry, name) for entry in entries] for name in schema.OBJECTS.arrays}
    add_table(root, "objects", schema.OBJECTS, columns, level, {"names": [entry.name for entry in entries]})
    known: dict[str, list[Any]] = {"fixed_to": [camera.fixed_to for camera in cameras], "shutter": [camera.shutter for camera in cameras]}
    known["distortion"] = [camera.distortion or None for camera in cameras]
    usual = {"fixed_to": WORLD, "distortion": None, "shutter": (0.0, 0.0)}
    unusual = {name: values for name, values in known.items() if any(value != usual[name] for value in values)}
    columns = {name: [getattr(camera, name) for camera in cameras] for name in schema.CAMERAS.arrays}
    add_table(root, "cameras", schema.CAMERAS, columns, level, unusual)
    add_group(root, schema.EPISODES, schema.GroupSpec("One group an episode, named by its number with six digits."))


SPOOL_ROWS = 32
"""Maximum number of rows of a write task, each of another episode: about 2 MB with 24 instances."""
ROWS = "rows"
"""Name of the spool file in an episode's staging folder."""
_OWN = ("object_id", "pose", "fixture_pose", "fixture_visible", "time")
"""Fields that every `TickBatch` has."""
_TABLES = {"ticks": schema.TICKS.arrays, "steps": schema.STEPS.arrays}
_COMPUTED = "steps/time"
"""Array that rows omit: it is computed from the tick's time when the group is written."""


def field_name(group: str, name: str) -> str:
    """Name of the field of an array in a spool row's structured type."""
    return f"{group}/{name}"


@cache
def row_type(ticks: tuple[str, ...], steps: tuple[str, ...], instances: int, steps_per_tick: int) -> np.dtype:
    """Structured type of a row: one tick of the named arrays of `TICKS` and `STEPS`, in this order."""
    fields = []
    for group, names in (("ticks", ticks), ("steps", steps)):
        for name in names:
            quantity = _TABLES[group][name]
            if field_name(group, name) != _COMPUTED:
                shape = quantity.shape({"tick": 1, "step": steps_per_tick, "instance": instances})
                fields.append((field_name(group, name), quantity.dtype, shape if group == "steps" else shape[1:]))
    return np.dtype(fields)


def spool_bytes(instances: int, steps_per_tick: int, has_steps: bool) -> int:
    """Maximum size of the rows of one task [B]; `instances`: capacity of a world, `has_steps`: whether steps are recorded."""
    steps = tuple(schema.STEPS.arrays) if has_steps else ()
    return SPOOL_ROWS * row_type(tuple(schema.TICKS.arrays), steps, instances, steps_per_tick).itemsize


def batch_type(batch: TickBatch, instances: int, steps_per_tick: int) -> np.dtype:
    """Structured type of rows that hold a batch's arrays, of an episode with this number of instances; raises ValueError if the batch has
    arrays of steps that the schema lacks; such arrays of ticks are left out."""
    ticks = tuple(name for name in schema.TICKS.arrays if name in _OWN or name in batch.tick)
    steps = tuple(name for name in schema.STEPS.arrays if name in batch.steps)
    if len(steps) != len(batch.steps):
        raise ValueError(f"steps have {set(batch.steps) - set(steps)}, which nothing describes")
    return row_type(ticks, steps, instances, steps_per_tick)


def make_rows(batch: TickBatch, row: np.dtype, instances: int) -> np.ndarray:
    """Rows (frame) of the type `row`, by `batch_type`, of episodes with as many instances; the capacity of a world may be larger."""
    rows = np.empty(len(batch), row)
    for name in row.names or ():
        group, _, array = name.partition("/")
        if group == "steps":
            values, frames = batch.steps[array], 1
        else:
            values, frames = getattr(batch, array) if array in _OWN else batch.tick[array], 0
        dims = _TABLES[group][array].dims
        rows[name] = values[(slice(None),) * frames + tuple(slice(instances if dim == "instance" else None) for dim in dims)]
    # The buffer's content for an absent instance depends on the world's earlier episodes.
    rows["ticks/pose"][rows["ticks/object_id"] == -1] = np.nan
    return rows


def write_rows(rows: np.ndarray, staging: Path, places: Sequence[tuple[str, int]]) -> None:
    """Task: write rows as bytes (row, byte) uint8 to the spool files of their episodes. Tasks may run in any order.

    `places` are the staging folder of each row's episode, by name in `staging`, and the row's offset in the spool file there [B].
    """
    for row, (folder, offset) in zip(rows, places, strict=True):
        _write_row(row, os.path.join(staging, folder, ROWS), offset)


def _write_row(row: np.ndarray, path: str, offset: int) -> None:
    """Write a row of bytes to a file at `offset` [B]; raises OSError that names the file."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        rest = memoryview(row.data)
        while rest:
            written = os.pwrite(handle, rest, offset)
            offset, rest = offset + written, rest[written:]
    except OSError as error:
        raise OSError(error.errno, error.strerror, path) from error
    finally:
        os.close(handle)


GROUP = "group"
"""Name of the group in an episode's staging folder."""


@dataclass(eq=False)
class SpooledEpisode:
    """What is kept of an episode whose ticks are being spooled: all that its group holds besides these and its attempts."""

    row: np.dtype
    """Type of a row of its spool file."""
    attributes: dict[str, Any]
    object_id: np.ndarray
    """obj_id of each instance at the first frame (instance) int32."""
    drop_pose: np.ndarray | None
    """Poses at which the objects were dropped (instance, 7) float32; None: not recorded."""
    count: int = 0
    """Number of ticks so far."""


def write_episode(
    folder: Path, episode: SpooledEpisode, attempts: Sequence[str], place: Path, masses: Mapping[int, float], settings: ExportSettings
) -> None:
    """Task: write an episode's group, of the rows in its staging folder and its lines of attempts.jsonl, and rename it to its place.

    `masses` [kg] are by obj_id.
    """
    group = zarr.create_group(folder / GROUP, attributes=episode.attributes)
    level = settings.trajectory.level
    _write_rows(group, np.memmap(folder / ROWS, episode.row, "r", shape=(episode.count,)), settings)
    missing = np.full((len(episode.object_id), 7), np.nan, np.float32)
    arrangement = {
        "object_id": episode.object_id,
        "mass": np.array([masses.get(int(obj_id), np.nan) for obj_id in episode.object_id]),
        "drop_pose": missing if episode.drop_pose is None else episode.drop_pose,
    }
    add_table(group, "arrangement", schema.ARRANGEMENT, arrangement, level)
    arrays = make_attempt_arrays([json.loads(line) for line in attempts], len(episode.object_id))
    arrays["record"] = np.frombuffer("".join(attempts).encode(), np.uint8)
    add_table(group, "attempts", schema.ATTEMPTS, arrays, level)
    for path in sorted((folder / GROUP).rglob("*")):
        (sync_folder if path.is_dir() else sync_file)(path)
    sync_folder(folder / GROUP)
    (folder / GROUP).rename(place)
    sync_folder(place.parent)


def _write_rows(group: zarr.Group, rows: np.ndarray, settings: ExportSettings) -> None:
    """Write the groups `ticks` and `steps`, one array after the other to bound memory."""
    steps = settings.physics.steps_per_tick
    for name, rows_per_tick in (("ticks", 1), ("steps", steps)):
        names = rows.dtype.names or ()
        given = {array: rows[field_name(name, array)] for array in schema.EPISODE_GROUPS[name].arrays if field_name(name, array) in names}
        if name == "steps" and given:
            # The time at each step's end, counted back from the tick's time.
            given["time"] = rows["ticks/time"][:, None] - settings.physics.step * np.arange(steps - 1, -1, -1)
        if not given:
            continue
        target = add_group(group, name, schema.EPISODE_GROUPS[name])
        chunk, shard = chunk_layout(settings.trajectory, len(rows), rows_per_tick)
        for array, spec in schema.EPISODE_GROUPS[name].arrays.items():
            if array in given:
                values = given[array]
                data = _FlattenedSteps(values) if name == "steps" else values
                add_array(target, array, spec, data, settings.trajectory.level, chunk, shard)  # type: ignore[arg-type]


class _FlattenedSteps:
    """Lazy reshape of an array (tick, step, ...) to (tick · step, ...): only slices are read; they begin and end at whole ticks."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._rows = values.shape[1]
        self.shape = (values.shape[0] * values.shape[1], *values.shape[2:])
        self.size = values.size

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, part: slice) -> np.ndarray:
        values = self._values[part.start // self._rows : part.stop // self._rows]
        return values.reshape(-1, *self.shape[1:])


def make_attempt_arrays(attempts: Sequence[Mapping[str, Any]], instances: int) -> dict[str, np.ndarray]:
    """Convert attempts (lines of attempts.jsonl) to the arrays of ATTEMPTS, with NaN, -1 or 0 for unknown; `record` stays empty."""
    ticks = max((len(attempt["peak_force"]) for attempt in attempts), default=0)
    sizes = {"attempt": len(attempts), "instance": instances, "lift_tick": ticks, "byte": 0}
    columns = {}
    for name, spec in schema.ATTEMPTS.arrays.items():
        dtype = np.dtype(spec.dtype)
        missing = {"f": np.nan, "i": -1}.get(dtype.kind, 0)
        column = columns[name] = np.full(spec.shape(sizes), missing, dtype)
        if name == "record":
            continue
        for row, attempt in enumerate(attempts):
            value = attempt[name]
            if name == "outcome":
                column[row] = Outcome[value.upper()]
            elif name == "peak_force":
                column[row, : len(value)] = value
            elif name in ("engaged", "picked"):
                column[row, list(value)] = True
            elif value is not None:
                column[row] = value
    return columns


_Staged = StagedEpisode[SpooledEpisode]


class TrajectoryExporter(EpisodeExporter[SpooledEpisode]):
    """`Exporter` of zarr. Episode k becomes the group `episodes/k` of one store.

    Ticks are spooled to a hidden file, from which a writer process makes the group when the episode has ended. A task spools one tick of
    many episodes, so that the bake's work grows with the arrays of a tick more than with its worlds.
    """

    needs_physics = True
    staging = "trajectory"

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        self._masses = {body.obj_id: body.mass for body in context.catalog.bodies}

    @staticmethod
    def slot_bytes(settings: ExportSettings) -> int:
        size = spool_bytes(settings.objects, settings.physics.steps_per_tick, settings.trajectory.steps)
        return shared_bytes((size,))

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles(schema.CONSTANT_FILES, (), (schema.STORE / schema.EPISODES, schema.STORE))

    def write_constants(self) -> list[Path]:
        with output_errors(self._context.out / schema.STORE):
            write_constants(self._context)
        return list(schema.CONSTANT_FILES)

    def write_ticks(self, batch: TickBatch) -> None:
        indices = batch.episode.tolist()
        episodes = [self._staged(index, partial(self._make_content, batch, world)) for world, index in enumerate(indices)]
        self._context.pool.submit_all(self._spool(batch, episodes))

    def places(self, episode: int) -> tuple[Path]:
        return (schema.STORE / schema.EPISODES / f"{episode:06d}",)

    def _make_content(self, batch: TickBatch, world: int, _: Path) -> SpooledEpisode:
        """What the first tick of an episode tells, that of a world of a batch."""
        present = np.flatnonzero(batch.object_id[world] != -1)
        instances = int(present[-1]) + 1 if present.size else 0
        light = int(batch.light[world])
        initial: dict[str, Any] = {
            "light": {
                "map": light,
                "name": self._context.lights[light].name,
                "yaw": float(batch.light_yaw[world]),
                "exposure": float(batch.light_exposure[world]),
                "units": {"yaw": "rad", "exposure": "EV"},
            }
        }
        if "mode" in batch.tick:
            initial["mode"] = Mode(int(batch.tick["mode"][world])).name.lower()
        if "redrops" in batch.tick:
            initial["redrops"] = int(batch.tick["redrops"][world])
        drop_pose = batch.tick["drop_pose"][world, :instances].copy() if "drop_pose" in batch.tick else None
        object_id = batch.object_id[world, :instances].copy()
        if drop_pose is not None:
            drop_pose[object_id == -1] = np.nan
        row = batch_type(batch, instances, self._context.settings.physics.steps_per_tick)
        return SpooledEpisode(row, initial, object_id, drop_pose)

    def _spool(self, batch: TickBatch, episodes: Sequence[_Staged]) -> Iterator[WriteTask]:
        """Tasks that spool a batch, each the frames of at most SPOOL_ROWS of its `episodes` (frame) whose rows have the same type."""
        groups: dict[int, list[int]] = {}
        for frame, episode in enumerate(episodes):
            groups.setdefault(len(episode.content.object_id), []).append(frame)
        for instances, frames in groups.items():
            for first in range(0, len(frames), SPOOL_ROWS):
                part = frames[first : first + SPOOL_ROWS]
                owners = [episodes[frame] for frame in part]
                rows = make_rows(batch.select(np.array(part)), owners[0].content.row, instances)
                places = [(episode.folder.name, episode.content.count * rows.itemsize) for episode in owners]
                for episode in owners:
                    episode.content.count += 1
                image = rows.view(np.uint8).reshape(len(rows), rows.itemsize)
                yield self._task(owners, write_rows, (image,), (self._staging, places), self._staging)

    def _commit(self, episode: _Staged, end: EpisodeEnd) -> WriteTask:
        kept = episode.content
        if kept.count != end.frames:
            raise ValueError(f"episode {end.episode} ended with {end.frames} frames, but {kept.count} came")
        ending = Ending(end.ending)
        kept.attributes = {
            "episode": end.episode,
            "arrangement": end.arrangement,
            "frames": end.frames,
            "ending": ending.name.lower(),
            "sentence": ending.sentence,
            "seed": self._context.settings.bake.seed,
            **end.row,
            **kept.attributes,
        }
        place = self._context.out / self.places(end.episode)[0]
        return WriteTask(write_episode, (), (episode.folder, kept, end.attempts, place, self._masses, self._context.settings), place)
