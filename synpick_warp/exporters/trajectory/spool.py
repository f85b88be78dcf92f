"""Spool of an episode's ticks: rows of one structured type, written to disk a few at a time, so that memory stays constant."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from synpick_warp.exporters.trajectory.arrays import STEPS, TICKS, ArraySpec
from synpick_warp.frames import TickBatch

SPOOL_TICKS = 8
"""Number of ticks of an episode handed to a writer at once: at most half a megabyte with 24 objects."""
_OWN = ("object_id", "pose", "fixture_pose", "fixture_visible", "time")
"""Fields that every `TickBatch` has."""
_TABLES = {"ticks": TICKS.arrays, "steps": STEPS.arrays}
_COMPUTED = "steps/time"
"""Computed from the tick's time when the group is written."""


def field_name(group: str, name: str) -> str:
    """Name of an array's field in a row."""
    return f"{group}/{name}"


def row_type(ticks: dict[str, ArraySpec], steps: dict[str, ArraySpec], instances: int, steps_per_tick: int) -> np.dtype:
    """Structured type of a row: one tick's part of all arrays, in the order of their tables."""
    fields = []
    for group, quantities in (("ticks", ticks), ("steps", steps)):
        for name, quantity in quantities.items():
            if field_name(group, name) != _COMPUTED:
                shape = quantity.shape({"tick": 1, "step": steps_per_tick, "instance": instances})
                fields.append((field_name(group, name), quantity.dtype, shape if group == "steps" else shape[1:]))
    return np.dtype(fields)


def spool_bytes(instances: int, steps_per_tick: int, has_steps: bool) -> int:
    """Maximum size of the rows of one task [B].

    Args:
        instances: Instance capacity of a world.
        steps_per_tick: Number of physics steps in a tick.
        has_steps: Whether steps are recorded.
    """
    steps = dict(STEPS.arrays) if has_steps else {}
    return SPOOL_TICKS * row_type(dict(TICKS.arrays), steps, instances, steps_per_tick).itemsize


def batch_type(batch: TickBatch, instances: int) -> np.dtype:
    """Structured type of rows that hold a batch's arrays.

    Raises:
        ValueError: The batch has arrays that the schema lacks.
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
        if _has_instances(_TABLES[group][array]):
            values = values[:, : row[name].shape[1]] if axis else values[: row[name].shape[0]]
        row[name] = values
    # The buffer's content for an absent instance depends on the world's earlier episodes.
    row["ticks/pose"][row["ticks/object_id"] < 0] = np.nan


def _has_instances(quantity: ArraySpec) -> bool:
    return quantity.dims[1:2] == ("instance",)


def write_rows(rows: np.ndarray, path: Path, offset: int) -> None:
    """Task: write rows, as bytes, to the spool file at a byte offset. Tasks may run in any order."""
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


def read_rows(path: Path, row: np.dtype, count: int) -> np.ndarray:
    """Memory-map all rows of a spool file (tick)."""
    return np.memmap(path, row, "r", shape=(count,))


def count_instances(batch: TickBatch, world: int) -> int:
    """Size of a world's instance dimension: 1 + the largest index of an instance at its first frame."""
    present = np.flatnonzero(batch.object_id[world] >= 0)
    return int(present[-1]) + 1 if present.size else 0
