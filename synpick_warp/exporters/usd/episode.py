"""Spool of an episode's ticks on disk, so that memory stays constant however long and many the episodes are, and the task that makes its
USD file of them.

It runs in writer processes, so this module imports neither Warp nor Newton, and pxr only when there is an episode to write.
"""

from pathlib import Path

import numpy as np

from synpick_warp.errors import OutputError
from synpick_warp.exporters.usd.types import UsdSettings
from synpick_warp.exporters.writing.files import sync_file, sync_folder
from synpick_warp.views.frames import EpisodeEnd, TickBatch

TICKS = 64
"""Number of ticks that are buffered in memory: about 50 kB per world."""


class TickSpool:
    """Buffered writer of one arrangement's ticks, which appends to a file, TICKS rows at a time; `instances`: capacity of a world."""

    def __init__(self, path: Path, instances: int) -> None:
        self.path, self.instances = path, instances
        self._rows = np.zeros((TICKS, tick_type(instances).itemsize), np.uint8)
        self._count = 0

    def add(self, row: np.ndarray) -> None:
        """Append a row of `tick_rows`. Raises OSError."""
        self._rows[self._count] = row
        self._count += 1
        if self._count == TICKS:
            self.flush()

    def flush(self) -> None:
        """Write the buffered ticks to the file. Raises OSError."""
        with self.path.open("ab") as file:
            file.write(self._rows[: self._count].tobytes())
        self._count = 0


def tick_type(instances: int) -> np.dtype:
    """Structured type of a row of the file: fields of `TickBatch`."""
    return np.dtype(
        [
            ("frame", "<i4"),
            ("bin", "<i4"),
            ("object_id", "<i4", instances),
            ("pose", "<f4", (instances, 7)),
            ("fixture_pose", "<f4", (3, 7)),
            ("fixture_visible", "<i4", 3),
            ("light", "<i4"),
            ("light_yaw", "<f4"),
            ("light_exposure", "<f4"),
        ]
    )


def tick_rows(batch: TickBatch) -> np.ndarray:
    """Rows of `tick_type`, as bytes, of all frames of a batch (frame, byte) uint8."""
    rows = np.empty(len(batch), tick_type(batch.object_id.shape[1]))
    for name in rows.dtype.names or ():
        rows[name] = getattr(batch, name)
    return rows.view(np.uint8).reshape(len(rows), rows.itemsize)


def read_ticks(path: Path, instances: int) -> np.ndarray:
    """Read all ticks of a file, in order, as rows of `tick_type` (frame)."""
    return np.fromfile(path, tick_type(instances))


def write_episode(spool: Path, instances: int, place: Path, end: EpisodeEnd, settings: UsdSettings) -> None:
    """Task: write an episode's file beside its spool, of a `TickSpool` with this capacity, and rename it to its place beside `assets/`."""
    from synpick_warp.exporters.usd.parts import save_layer
    from synpick_warp.exporters.usd.stage import make_episode_layer

    ticks = read_ticks(spool, instances)
    if ticks["frame"].tolist() != list(range(end.frames)):
        raise OutputError(f"{place} has {len(ticks)} of {end.frames} frames; this is an error of synpick-warp, please report it")
    staged = spool.with_name(f"{spool.name}.usdc")
    save_layer(make_episode_layer(ticks, end, settings), staged)
    sync_file(staged)
    staged.rename(place)
    sync_folder(place.parent)
