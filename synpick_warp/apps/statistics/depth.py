"""Depth range: planar depth of the pixels of sampled depth images, and fraction without measurement."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from synpick_warp.apps.statistics.counting import Counts

DEPTH_BIN = 5.0
"""Width of a bin of depth [mm]."""
QUANTILES = (0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
_LEVELS = 2**16
"""Number of values of a 16-bit depth image."""


@dataclass(frozen=True)
class Depth:
    """Depth of all pixels of the sampled views: their numbers, fraction without measurement, and quantiles [mm] (empty: none measured)."""

    views: int
    pixels: int
    missing: float
    """Fraction of the pixels without measurement."""
    quantiles: dict[float, float]
    """Quantile, one of QUANTILES -> depth, exact to DEPTH_BIN [mm]; empty: nothing was measured."""


@dataclass
class DepthCounts(Counts):
    """Accumulator of `Depth`: counts of views, pixels, pixels without measurement, and pixels by bin of depth."""

    totals: Counter[str] = field(default_factory=Counter)
    bins: Counter[tuple[str, int]] = field(default_factory=Counter)
    """Pixels by bin of depth."""

    def add_image(self, image: np.ndarray, scale: float) -> None:
        """Accumulate a depth image (H, W) uint16 with `scale` mm per count; 0 is no measurement."""
        levels = np.bincount(image.ravel(), minlength=_LEVELS)
        self.totals.update(views=1, pixels=image.size, missing=int(levels[0]))
        present = np.flatnonzero(levels[1:]) + 1
        bins = (present * (scale / DEPTH_BIN)).astype(np.int64)
        found: Counter[int] = Counter()
        for index, count in zip(bins.tolist(), levels[present].tolist(), strict=True):
            found[index] += count
        self.bins.update({("depth", index): count for index, count in found.items()})

    def result(self) -> Depth | None:
        """Depth statistics of all images; None: no depth image was read."""
        pixels = self.totals["pixels"]
        if not pixels:
            return None
        order = sorted(self.bins.items())
        bounds = np.cumsum([count for _, count in order])
        quantiles = {}
        for quantile in QUANTILES if order else ():
            # Rank of the pixel, from 1 on; both ends are pixels.
            rank = max(1, int(np.ceil(quantile * bounds[-1])))
            quantiles[quantile] = (order[int(np.searchsorted(bounds, rank))][0][1] + 0.5) * DEPTH_BIN
        return Depth(self.totals["views"], pixels, self.totals["missing"] / pixels, quantiles)
