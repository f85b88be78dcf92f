"""What an episode's USD file needs of its ticks, gathered in a file, so that memory stays flat however long and many the episodes are."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from synpick_warp.frames import TickBatch

TICKS = 64
"""Ticks of an episode that are kept in memory: about 50 kB a world."""
_FIELDS = ("frame", "object_id", "pose", "fixture_pose", "fixture_visible", "light", "light_yaw", "light_exposure")
"""Of `TickBatch`, with its shapes."""


class TickSpool:
    """The ticks of one arrangement of an episode."""

    def __init__(self, path: Path, instances: int) -> None:
        """
        Args:
            path: Grows, a piece of TICKS ticks at a time.
            instances: Room for instances of a world.
        """
        self.path, self.instances = path, instances
        self._rows = np.zeros(TICKS, tick_type(instances))
        self._count = 0

    def add(self, batch: TickBatch, world: int) -> None:
        """Take one world's tick. Raises OSError."""
        row = self._rows[self._count]
        for name in _FIELDS:
            row[name] = getattr(batch, name)[world]
        self._count += 1
        if self._count == TICKS:
            self.flush()

    def flush(self) -> None:
        """Bring all ticks into the file. Raises OSError."""
        with self.path.open("ab") as file:
            file.write(self._rows[: self._count].tobytes())
        self._count = 0


def tick_type(instances: int) -> np.dtype:
    """A row of the file."""
    return np.dtype(
        [
            ("frame", "<i4"),
            ("object_id", "<i4", instances),
            ("pose", "<f4", (instances, 7)),
            ("fixture_pose", "<f4", (3, 7)),
            ("fixture_visible", "<i4", 3),
            ("light", "<i4"),
            ("light_yaw", "<f4"),
            ("light_exposure", "<f4"),
        ]
    )


def read_ticks(path: Path, instances: int) -> np.ndarray:
    """All ticks of a file, in order, as rows of `tick_type` (frame)."""
    return np.fromfile(path, tick_type(instances))
