"""Bins: episodes by bin and by where it stands."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

from synpick_warp.apps.statistics.counting import Counts
from synpick_warp.apps.statistics.records import BinFacts

STEPS = {"x": 0.01, "y": 0.01, "yaw": math.radians(5.0)}
"""Widths of the intervals in which the places of bins are counted [m, rad]."""
Range = tuple[float, float]


@dataclass(frozen=True)
class BinUse:
    """Episodes of a bin, and the intervals of STEPS that its places span."""

    episodes: int
    x: Range
    """[m]"""
    y: Range
    """[m]"""
    yaw: Range
    """[rad]"""


@dataclass
class BinCounts(Counts):
    """Accumulator of `BinUse`: episode counts and ranges of the pose, by bin."""

    names: Counter[str] = field(default_factory=Counter)
    places: Counter[tuple[str, str, int]] = field(default_factory=Counter)

    def add_episode(self, own: BinFacts) -> None:
        """Count the bin of an episode."""
        self.names[own.name] += 1
        for axis, value in zip(STEPS, (*own.position[:2], own.yaw), strict=True):
            self.places[own.name, axis, math.floor(value / STEPS[axis])] += 1

    def result(self) -> dict[str, BinUse]:
        """Use of each bin, the most frequent first."""
        ranges: dict[str, list[Range]] = {}
        for name in self.names:
            for axis, step in STEPS.items():
                found = [index for owner, other, index in self.places if (owner, other) == (name, axis)]
                ranges.setdefault(name, []).append((min(found) * step, (max(found) + 1) * step))
        order = sorted(self.names.items(), key=lambda item: (-item[1], item[0]))
        return {name: BinUse(count, *ranges[name]) for name, count in order}
