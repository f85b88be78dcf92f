"""Bounded quantities of a data set check: their worst value, their verdict, and the table of all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


class UnusableError(Exception):
    """The folder is not a data set that can be checked, or a file of it cannot be read."""


@dataclass
class Measure:
    """Bounded quantity: the largest magnitude of all values (`update_max`), or the percentage of bad pixels (`add_pixels`)."""

    name: str
    unit: str
    allowed: float
    worst: float = 0.0
    where: str = ""
    """Image, scene or episode of the worst value; of percentages, of the first bad pixel."""
    bad: int = 0
    total: int = 0
    """Values or pixels so far."""

    def update_max(self, values: npt.ArrayLike, where: str) -> None:
        """Take the maximum with the magnitudes of `values`, which are of `where`."""
        magnitudes = np.abs(np.asarray(values, dtype=np.float64))
        if not magnitudes.size:
            return
        self.total += magnitudes.size
        worst = float(magnitudes.max())
        if not worst <= self.worst:  # NaN is the worst value.
            self.worst, self.where = worst, where

    def add_pixels(self, bad: npt.ArrayLike, total: npt.ArrayLike, where: str) -> None:
        """Count the bad pixels and all pixels of the image `where`, given as masks."""
        count = int(np.count_nonzero(bad))
        if count and not self.bad:
            self.where = where
        self.bad += count
        self.total += int(np.count_nonzero(total))
        self.worst = 100.0 * self.bad / max(self.total, 1)

    @property
    def holds(self) -> bool:
        """Whether the worst value is within the bound."""
        return self.worst <= self.allowed


def print_measures(measures: Iterable[Measure]) -> bool:
    """Print the table of all quantities; returns whether all bounds hold."""
    held = True
    print(f"{'quantity':<60} {'measured':>12} {'allowed':>9} {'unit':<8} {'count':>10}  worst case")
    for measure in measures:
        worst = f"{measure.worst:.6g}" if measure.total else "-"
        verdict = "" if measure.holds else "  VIOLATED"
        print(f"{measure.name:<60} {worst:>12} {measure.allowed:>9g} {measure.unit:<8} {measure.total:>10}  {measure.where}{verdict}")
        held = held and measure.holds
    return held
