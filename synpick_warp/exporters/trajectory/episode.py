"""Task that writes an episode's group in the zarr store. It runs in writer processes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from synpick_warp.codes import Outcome
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.exporters.trajectory.arrays import ARRANGEMENT, ATTEMPTS, EPISODE_GROUPS
from synpick_warp.exporters.trajectory.spool import ROWS, field_name
from synpick_warp.exporters.trajectory.store import add_array, add_group, add_table, chunk_layout
from synpick_warp.exporters.writing.files import sync_file, sync_folder

GROUP = "group"
"""Name of the group in an episode's staging folder."""


@dataclass(eq=False)
class SpooledEpisode:
    """What is kept of an episode whose ticks are being spooled: all that its group holds besides these and its attempts."""

    row: np.dtype
    """Type of a row of its spool file."""
    attributes: dict[str, Any]
    """Attributes of its group."""
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
    add_table(group, "arrangement", ARRANGEMENT, arrangement, level)
    arrays = make_attempt_arrays([json.loads(line) for line in attempts], len(episode.object_id))
    arrays["record"] = np.frombuffer("".join(attempts).encode(), np.uint8)
    add_table(group, "attempts", ATTEMPTS, arrays, level)
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
        given = {array: rows[field_name(name, array)] for array in EPISODE_GROUPS[name].arrays if field_name(name, array) in names}
        if name == "steps" and given:
            # The time at each step's end, counted back from the tick's time.
            given["time"] = rows["ticks/time"][:, None] - settings.physics.step * np.arange(steps - 1, -1, -1)
        if not given:
            continue
        target = add_group(group, name, EPISODE_GROUPS[name])
        chunk, shard = chunk_layout(settings.trajectory, len(rows), rows_per_tick)
        for array, spec in EPISODE_GROUPS[name].arrays.items():
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
    for name, spec in ATTEMPTS.arrays.items():
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
