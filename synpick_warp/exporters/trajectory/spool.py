"""Ticks of an episode on their way into its arrays: rows of one type, a few at a time, so that memory stays flat."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.trajectory.arrays import STEPS, TICKS, Quantity
from synpick_warp.frames import TickBatch

SPOOL_TICKS = 8
"""Ticks of an episode that are handed over at once: at most half a megabyte, with 24 objects."""
_OWN = ("object_id", "pose", "fixture_pose", "fixture_visible", "time")
"""Arrays of a tick that `TickBatch` always has."""
_TABLES = {"ticks": TICKS.arrays, "steps": STEPS.arrays}
_COMPUTED = "steps/time"
"""Follows from the tick's time."""


def field_name(group: str, name: str) -> str:
    """Of an array in a row."""
    return f"{group}/{name}"


def row_type(ticks: dict[str, Quantity], steps: dict[str, Quantity], instances: int, steps_per_tick: int) -> np.dtype:
    """A row: one tick's part of the arrays, in the order of their names' tables."""
    fields = []
    for group, quantities in (("ticks", ticks), ("steps", steps)):
        for name, quantity in quantities.items():
            if field_name(group, name) != _COMPUTED:
                shape = quantity.shape({"tick": 1, "step": steps_per_tick, "instance": instances})
                fields.append((field_name(group, name), quantity.dtype, shape if group == "steps" else shape[1:]))
    return np.dtype(fields)


def spool_bytes(config: Config) -> int:
    """Most room that the rows of one task take [B]."""
    steps = dict(STEPS.arrays) if config.trajectory.steps else {}
    return SPOOL_TICKS * row_type(dict(TICKS.arrays), steps, config.arrangement.max_objects, config.physics.steps_per_tick).itemsize


def batch_type(batch: TickBatch, instances: int) -> np.dtype:
    """Rows that hold what a batch has.

    Raises:
        ValueError: It has arrays that the tables do not name.
    """
    ticks = {name: quantity for name, quantity in TICKS.arrays.items() if name in _OWN or name in batch.tick}
    steps = {name: quantity for name, quantity in STEPS.arrays.items() if name in batch.steps}
    if len(steps) != len(batch.steps):
        raise ValueError(f"steps have {set(batch.steps) - set(steps)}, which nothing describes")
    rows = next(iter(batch.steps.values())).shape[1] if batch.steps else 0
    return row_type(ticks, steps, instances, rows)


def fill_row(row: np.void, batch: TickBatch, world: int) -> None:
    """Copy one world's tick into a row."""
    for name in row.dtype.names or ():
        group, _, array = name.partition("/")
        if group == "steps":
            values, axis = batch.steps[array][world], 1
        else:
            values, axis = (getattr(batch, array) if array in _OWN else batch.tick[array])[world], 0
        if _is_instance(_TABLES[group][array]):
            values = values[:, : row[name].shape[1]] if axis else values[: row[name].shape[0]]
        row[name] = values
    # Whatever the buffer has of an instance that is not there depends on who used it before.
    row["ticks/pose"][row["ticks/object_id"] < 0] = np.nan


def _is_instance(quantity: Quantity) -> bool:
    return quantity.dims[1:2] == ("instance",)


def write_rows(rows: np.ndarray, path: Path, offset: int) -> None:
    """Task: put rows, as bytes, into an episode's file, from a byte on. Tasks may come in any order."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        rest = memoryview(rows.data)
        while rest:
            written = os.pwrite(handle, rest, offset)
            offset, rest = offset + written, rest[written:]
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        os.close(handle)


def read_rows(path: Path, kind: np.dtype, count: int) -> np.ndarray:
    """All rows of an episode's file, which stay there until they are looked at (tick)."""
    return np.memmap(path, kind, "r", shape=(count,))


def present(batch: TickBatch, world: int) -> int:
    """Instances that a world has at its first frame: one more than the index of the last."""
    there = np.flatnonzero(batch.object_id[world] >= 0)
    return int(there[-1]) + 1 if there.size else 0
