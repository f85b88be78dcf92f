"""Light maps: episodes by environment map, yaw and exposure compensation."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

from synpick_warp.apps.statistics.counting import Counts, histogram
from synpick_warp.apps.statistics.records import Light

YAW_BINS = 12
"""Bins of the yaw, of equal width over a full turn, from 0."""
EXPOSURE_BIN = 0.1
"""Width of a bin of the exposure compensation [EV]."""


@dataclass(frozen=True)
class Lights:
    """Light of the episodes: their number by environment map, bin of yaw, and bin of exposure compensation [EV]."""

    episodes: int
    maps: dict[str, int]
    """Episodes by name of the environment map."""
    yaw: tuple[int, ...]
    """Episodes by yaw, in YAW_BINS bins."""
    exposure: dict[float, int]
    """Episodes by exposure compensation: begin of the bin [EV] -> episodes; bins are EXPOSURE_BIN wide."""


@dataclass
class LightCounts(Counts):
    """Accumulator of `Lights`: episodes by map, bin of yaw and bin of exposure compensation."""

    maps: Counter[str] = field(default_factory=Counter)
    yaw: Counter[tuple[str, int]] = field(default_factory=Counter)
    exposure: Counter[int] = field(default_factory=Counter)

    def add_episode(self, light: Light) -> None:
        """Count the environment map, yaw [rad] and exposure compensation [EV] of an episode."""
        self.maps[light.map] += 1
        self.yaw["yaw", math.floor(light.yaw / math.tau * YAW_BINS) % YAW_BINS] += 1
        self.exposure[math.floor(light.exposure / EXPOSURE_BIN)] += 1

    def result(self) -> Lights | None:
        """Light of all episodes; None: no episode names its light."""
        if not self.maps:
            return None
        maps = dict(sorted(self.maps.items(), key=lambda item: (-item[1], item[0])))
        exposure = {round(index * EXPOSURE_BIN, 6): count for index, count in sorted(self.exposure.items())}
        return Lights(self.maps.total(), maps, histogram(self.yaw, "yaw", YAW_BINS), exposure)
