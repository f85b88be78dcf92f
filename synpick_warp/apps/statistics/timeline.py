"""Objects over time: mean number of objects in the scene by simulated time since the first frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from synpick_warp.apps.statistics.counting import Counts, Group
from synpick_warp.apps.statistics.scenes import SceneTruth

TIME_BIN = 2.0
"""Width of a bin of time [s]."""


class TimePoint(NamedTuple):
    """Bin of time since the first frame: its start [s], its frames over all episodes, and the mean number of objects in them."""

    time: float
    """Start of the bin since the first frame [s]."""
    frames: int
    """Frames of the bin, over all episodes that last so long."""
    objects: float
    """Mean number of objects in the scene, in these frames."""


@dataclass
class TimelineCounts(Counts):
    """Accumulator of `TimePoint`s: frames and objects by group and bin of time, from one camera of each episode."""

    frames: Counter[tuple[Group, int]] = field(default_factory=Counter)
    objects: Counter[tuple[Group, int]] = field(default_factory=Counter)

    def add_scene(self, group: Group, scene: SceneTruth, period: float) -> None:
        """Count a scene's instances by time; `period` is the time from frame to frame [s]."""
        frames = np.asarray(scene.images or range(scene.frames))
        bins = (frames * (period / TIME_BIN) + _ROUNDING).astype(np.int64)
        for index in np.unique(bins).tolist():
            self.frames[group, index] += int((bins == index).sum())
            self.objects[group, index] += int(scene.counts[bins == index].sum())

    def result(self, groups: Iterable[Group]) -> tuple[TimePoint, ...]:
        """Mean number of objects over time in these groups together."""
        groups = tuple(groups)
        bins = sorted({index for group, index in self.frames if group in groups})
        points = []
        for index in bins:
            frames = sum(self.frames[group, index] for group in groups)
            points.append(TimePoint(index * TIME_BIN, frames, sum(self.objects[group, index] for group in groups) / frames))
        return tuple(points)


_ROUNDING = 1e-9
"""Frames at the begin of a bin belong to it, also if their time is rounded down."""
