"""Spool files of trajectories: fixed-size records, one per tick of an episode. A write task has one tick of many episodes."""

import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from synpick_warp.exporters.trajectory.arrays import STEPS, TICKS
from synpick_warp.views.frames import TickBatch

SPOOL_ROWS = 32
"""Maximum number of rows of a write task, each of another episode: about 2 MB with 24 instances."""
ROWS = "rows"
"""Name of the spool file in an episode's staging folder."""
_OWN = ("object_id", "pose", "fixture_pose", "fixture_visible", "time")
"""Fields that every `TickBatch` has."""
_TABLES = {"ticks": TICKS.arrays, "steps": STEPS.arrays}
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
    steps = tuple(STEPS.arrays) if has_steps else ()
    return SPOOL_ROWS * row_type(tuple(TICKS.arrays), steps, instances, steps_per_tick).itemsize


def batch_type(batch: TickBatch, instances: int, steps_per_tick: int) -> np.dtype:
    """Structured type of rows that hold a batch's arrays, of an episode with this number of instances; raises ValueError if the batch has
    arrays of steps that the schema lacks; such arrays of ticks are left out."""
    ticks = tuple(name for name in TICKS.arrays if name in _OWN or name in batch.tick)
    steps = tuple(name for name in STEPS.arrays if name in batch.steps)
    if len(steps) != len(batch.steps):
        raise ValueError(f"steps have {set(batch.steps) - set(steps)}, which nothing describes")
    return row_type(ticks, steps, instances, steps_per_tick)


def make_rows(batch: TickBatch, row: np.dtype, instances: int) -> np.ndarray:
    """Rows (frame) of the type `row`, by `batch_type`, of a batch of episodes that have the same number of instances; the capacity of a
    world may be larger."""
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
