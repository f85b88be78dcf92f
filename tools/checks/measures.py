"""Bounded quantities of a data set check: their worst value, their verdict, the table of all, and the command line of a check."""

import argparse
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from synpick_warp.errors import SynpickError
from tools.options import fail, positive_count


@dataclass
class MeasuredValue:
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


def print_measures(measures: Iterable[MeasuredValue]) -> bool:
    """Print the table of all quantities; returns whether all bounds hold."""
    held = True
    print(f"{'quantity':<60} {'measured':>12} {'allowed':>9} {'unit':<8} {'count':>10}  worst case")
    for measure in measures:
        worst = f"{measure.worst:.6g}" if measure.total else "-"
        verdict = "" if measure.holds else "  VIOLATED"
        print(f"{measure.name:<60} {worst:>12} {measure.allowed:>9g} {measure.unit:<8} {measure.total:>10}  {measure.where}{verdict}")
        held = held and measure.holds
    return held


def run_check(
    doc: str | None, samples: str, default: int, check: Callable[[Path, int], Mapping[str, MeasuredValue]], needed: Iterable[str]
) -> int:
    """Run the command line of a check that takes `default` or other numbers of `samples`, such as "views"; returns the exit code.

    Without values of the quantities `needed` nothing was checked.
    """
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    parser.add_argument("dataset", type=Path, metavar="DIR", help="folder of the data set")
    text = f"{samples} to check, spread over the data set (default %(default)s)"
    parser.add_argument(f"--{samples}", dest="count", type=positive_count, default=default, help=text)
    given = parser.parse_args()
    try:
        measures = check(given.dataset, given.count)
    except SynpickError as error:
        return fail(parser.prog, error)
    held = print_measures(measures.values())
    missing = next((measures[name].name for name in needed if not measures[name].total), None)
    if missing is not None:
        print(f"nothing was checked: no sample has values of '{missing}'")
    return 0 if held and missing is None else 1
