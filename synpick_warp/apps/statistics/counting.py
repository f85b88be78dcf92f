"""Accumulators: exact integer counts by key, so that partial ones merge to the same result in any order."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self

import numpy as np


class Group(NamedTuple):
    """Split and mode whose episodes are counted together."""

    split: str
    mode: str


@dataclass
class Counts:
    """Base of the accumulators: each field is a `Counter` with integer values."""

    def merge(self, other: Self) -> None:
        """Add the counts of another accumulator."""
        for item in fields(self):
            getattr(self, item.name).update(getattr(other, item.name))


def add_bins(counts: Counter[Any], key: Any, bins: np.ndarray) -> None:
    """Count values by bin, as `counts[key, bin]`; bins (N,) int."""
    found, number = np.unique(bins, return_counts=True)
    for each, count in zip(found.tolist(), number.tolist(), strict=True):
        counts[key, each] += count


def histogram(counts: Counter[Any], key: Any, size: int) -> tuple[int, ...]:
    """Counts of bins 0 to `size` - 1 that `add_bins` counted under a key."""
    return tuple(counts[key, index] for index in range(size))
