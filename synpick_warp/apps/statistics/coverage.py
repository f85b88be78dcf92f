"""Pose coverage: from which directions cameras see each object, in equal-area bins of the sphere in the object's frame.

A bin is a cell of Lambert's cylindrical projection: equal steps of z and of longitude have equal areas (Archimedes' hat-box theorem).
Symmetries of objects are not taken into account: of a can, all longitudes look the same, and count as different.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from synpick_warp.apps.statistics.counting import Counts, add_bins
from synpick_warp.apps.statistics.scenes import SceneTruth

BANDS, SECTORS = 12, 24
"""Steps of z from -1 to 1, and of longitude from -180° to 180°."""
BINS = BANDS * SECTORS
MIN_VISIBILITY = 0.1
"""Visible fraction from which a view of an object counts, as in BOP's target lists."""


@dataclass(frozen=True)
class Coverage:
    """Viewing directions of one object, in its frame: views, fraction of bins of the sphere that have any, evenness (0 to 1),
    views by bin.
    """

    views: int
    """Instances of which at least MIN_VISIBILITY is visible."""
    occupied: float
    """Fraction of the bins with at least one of them."""
    evenness: float
    """Entropy of the bins relative to that of an even distribution: 1, if all bins have as many; 0, if one bin has all."""
    bins: tuple[int, ...]
    """Views by bin, BANDS x SECTORS, from z = -1 and longitude -180° on, longitude first."""


@dataclass
class CoverageCounts(Counts):
    """Accumulator of `Coverage`: views by obj_id and bin of the viewing direction."""

    bins: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Views by obj_id and bin."""

    def add_scene(self, scene: SceneTruth) -> None:
        """Count the viewing directions of a scene's instances of which at least MIN_VISIBILITY is visible, or of which this is unknown."""
        # Instances of which it is not known count as seen.
        seen = ~(scene.visibility < MIN_VISIBILITY)
        code = scene.object_id[seen] * BINS + direction_bins(scene.direction[seen])
        found: Counter[tuple[int, int]] = Counter()
        add_bins(found, 0, code)
        for (_, each), count in found.items():
            self.bins[divmod(each, BINS)] += count

    def result(self, object_id: int) -> Coverage:
        """Coverage of an object: number of views, fraction of bins seen, evenness (entropy over its maximum, 0 to 1), views by bin."""
        bins = tuple(self.bins[object_id, index] for index in range(BINS))
        total = sum(bins)
        shares = [count / total for count in bins if count]
        evenness = max(0.0, -math.fsum(share * math.log(share) for share in shares)) / math.log(BINS)
        return Coverage(total, len(shares) / BINS, evenness, bins)


def direction_bins(direction: np.ndarray) -> np.ndarray:
    """Bin of each unit vector (N, 3), as (N,) int64."""
    x, y, z = direction.T
    band = np.clip(((z + 1.0) * (BANDS / 2.0)).astype(np.int64), 0, BANDS - 1)
    turn = (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * SECTORS
    return band * SECTORS + np.clip(turn.astype(np.int64), 0, SECTORS - 1)
