"""An episode's group in the zarr store, made of its rows. Runs in writer processes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from synpick_warp.codes import Outcome
from synpick_warp.configs.schema import Trajectory
from synpick_warp.exporters.trajectory.arrays import ARRANGEMENT, ATTEMPTS, EPISODE
from synpick_warp.exporters.trajectory.spool import field_name, read_rows
from synpick_warp.exporters.trajectory.store import add_array, add_group, shard_rows
from synpick_warp.exporters.writing.files import sync_file, sync_folder

GROUP, ROWS = "group", "rows"
"""In an episode's hidden folder."""


@dataclass(frozen=True)
class EpisodeSettings:
    """What is the same for all episodes."""

    trajectory: Trajectory
    step: float
    """[s]"""
    steps_per_tick: int
    masses: Mapping[int, float]
    """obj_id -> mass [kg]."""


@dataclass(frozen=True, eq=False)
class EpisodeFacts:
    """What an episode is, besides its rows."""

    attributes: Mapping[str, Any]
    """Of its group."""
    object_id: np.ndarray
    """At the first frame (instance) int32."""
    drop_pose: np.ndarray | None
    """(instance, 7) float32; None: it was not recorded."""
    attempts: Sequence[str]
    """Lines of JSON."""


def write_episode(folder: Path, kind: np.dtype, count: int, place: Path, facts: EpisodeFacts, settings: EpisodeSettings) -> None:
    """Task: write an episode's group and move it to its place.

    Args:
        folder: The episode's hidden folder, with its rows.
        kind: Type of these.
        count: How many there are.
        place: Where the group goes.
        facts: What else is known of the episode.
        settings: What is the same for all.
    """
    group = zarr.create_group(folder / GROUP, attributes=dict(facts.attributes))
    level = settings.trajectory.level
    rows = read_rows(folder / ROWS, kind, count)
    _write_rows(group, rows, settings)
    _write_arrangement(group, facts, settings)
    arrays = attempt_arrays([json.loads(line) for line in facts.attempts], len(facts.object_id))
    arrays["record"] = np.frombuffer("".join(facts.attempts).encode(), np.uint8)
    attempts = add_group(group, "attempts", ATTEMPTS)
    for name, quantity in ATTEMPTS.arrays.items():
        add_array(attempts, name, quantity, arrays[name], level)
    del rows
    for path in sorted((folder / GROUP).rglob("*")):
        if path.is_dir():
            sync_folder(path)
        else:
            sync_file(path)
    sync_folder(folder / GROUP)
    (folder / GROUP).rename(place)
    sync_folder(place.parent)
    shutil.rmtree(folder)


def drop_episode(folder: Path) -> None:
    """Task: remove an episode that delivers nothing."""
    shutil.rmtree(folder)


def _write_rows(group: zarr.Group, rows: np.ndarray, settings: EpisodeSettings) -> None:
    """The groups `ticks` and `steps`, one array after the other."""
    steps = settings.steps_per_tick
    for name, rows_per_tick in (("ticks", 1), ("steps", steps)):
        names = rows.dtype.names or ()
        given = {array: rows[field_name(name, array)] for array in EPISODE[name].arrays if field_name(name, array) in names}
        if name == "steps" and given:
            # Each step's end, back from the tick's.
            given["time"] = rows["ticks/time"][:, None] - settings.step * np.arange(steps - 1, -1, -1)
        if not given:
            continue
        made = add_group(group, name, EPISODE[name])
        chunk, shard = shard_rows(settings.trajectory, len(rows), rows_per_tick)
        for array, quantity in EPISODE[name].arrays.items():
            if array in given:
                values = given[array]
                data = _Flat(values) if name == "steps" else values
                add_array(made, array, quantity, data, settings.trajectory.level, chunk, shard)  # type: ignore[arg-type]


class _Flat:
    """An array (tick, step, ...) as (tick · step, ...), of which only what is sliced is read; slices begin and end with ticks."""

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


def _write_arrangement(group: zarr.Group, facts: EpisodeFacts, settings: EpisodeSettings) -> None:
    made = add_group(group, "arrangement", ARRANGEMENT)
    drop_pose = facts.drop_pose
    values = {
        "object_id": facts.object_id,
        "mass": np.array([settings.masses.get(int(number), np.nan) for number in facts.object_id]),
        "drop_pose": drop_pose if drop_pose is not None else np.full((len(facts.object_id), 7), np.nan, np.float32),
    }
    for name, quantity in ARRANGEMENT.arrays.items():
        add_array(made, name, quantity, values[name].astype(quantity.dtype), settings.trajectory.level)


def attempt_arrays(records: Sequence[Mapping[str, Any]], instances: int) -> dict[str, np.ndarray]:
    """Columns of the records of attempts, as the table ATTEMPTS has them, but for `record`."""
    ticks = max((len(record["load"]) for record in records), default=0)
    sizes = {"attempt": len(records), "instance": instances, "lift_tick": ticks, "byte": 0}
    made = {}
    for name, quantity in ATTEMPTS.arrays.items():
        kind = np.dtype(quantity.dtype)
        nothing = {"f": np.nan, "i": -1}.get(kind.kind, 0)
        column = made[name] = np.full(quantity.shape(sizes), nothing, kind)
        if name == "record":
            continue
        for row, record in enumerate(records):
            value = record[name]
            if name == "outcome":
                column[row] = Outcome[value.upper()]
            elif name == "load":
                column[row, : len(value)] = value
            elif name in ("caught", "picked"):
                column[row, list(value)] = True
            elif value is not None:
                column[row] = value
    return made
