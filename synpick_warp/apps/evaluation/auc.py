"""Area under the accuracy-threshold curve (AUC) of pose errors, recall curves, and scores by bands of a quantity.

Errors have one entry per true instance [m]; infinity stands for a missing detection, which counts as a miss. Two conventions of the area
are in use, and they differ for few instances:

- exact: the area under the step function, mean of max(0, 1 - e / limit), as in the code of ICG and FoundationPose.
- vocap: PoseCNN's, from the YCB-Video toolbox, also CosyPose's: the curve between two errors has the accuracy of the larger one, so n
  instances score up to 1 / n more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

LIMIT = 0.1
"""Largest threshold of the area [m]."""


def exact_auc(errors: np.ndarray, limit: float = LIMIT) -> float:
    """Exact area under the accuracy-threshold curve, from 0 to 1; NaN without errors.

    Args:
        errors: (N,) [m]; infinity: missed.
        limit: Largest threshold [m].
    """
    return float(np.maximum(0.0, 1.0 - errors / limit).mean()) if len(errors) else float("nan")


def vocap_auc(errors: np.ndarray, limit: float = LIMIT) -> float:
    """Area by PoseCNN's VOCap, from 0 to 1; NaN without errors. If every instance is missed it is 0, where PoseCNN's code has NaN.

    Arguments as `exact_auc`.
    """
    if not len(errors):
        return float("nan")
    found = np.sort(errors[errors <= limit])
    if not len(found):
        return 0.0
    # Of equal errors the original takes the accuracy of the first one for the step up to them.
    accuracy = np.arange(1, len(found) + 1) / len(errors)
    recall = np.concatenate(([0.0], found, [limit]))
    precision = np.concatenate(([0.0], accuracy, [accuracy[-1]]))
    steps = np.flatnonzero(recall[1:] != recall[:-1]) + 1
    return float(((recall[steps] - recall[steps - 1]) * precision[steps]).sum() / limit)


CONVENTIONS: dict[str, Callable[[np.ndarray], float]] = {"exact": exact_auc, "vocap": vocap_auc}
"""Convention -> area to LIMIT."""


def recall_curve(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Recall (accuracy): fraction of the instances with an error below each threshold.

    Args:
        errors: (N,) [m]; infinity: missed.
        thresholds: (T,) [m].

    Returns:
        (T,) from 0 to 1; NaN without errors.
    """
    if not len(errors):
        return np.full(len(thresholds), np.nan)
    return np.searchsorted(np.sort(errors), thresholds, side="left") / len(errors)


@dataclass(frozen=True)
class Band:
    """Scores of the instances whose quantity, such as visibility or speed, lies in [low, high)."""

    low: float
    high: float
    """The interval includes `low`, and `high` only in the last band."""
    count: int
    """Number of instances."""
    auc: float
    """Exact area, from 0 to 1; NaN without instances."""
    recall: float
    """Fraction with an error below LIMIT; NaN without instances."""
    median: float
    """Median error of those [m]; NaN if there is none."""


def band_indices(values: np.ndarray, edges: Sequence[float]) -> np.ndarray:
    """Index of the band of each value.

    Args:
        values: (N,).
        edges: Rising limits of the B bands (B + 1); a value at the last one belongs to the last band.

    Returns:
        (N,) int64; -1: outside of all bands, or NaN.
    """
    limits = np.asarray(edges, np.float64)
    index = np.searchsorted(limits, values, side="right") - 1
    index[values == limits[-1]] = len(limits) - 2
    index[(index >= len(limits) - 1) | np.isnan(values)] = -1
    return index


def error_bands(errors: np.ndarray, values: np.ndarray, edges: Sequence[float]) -> list[Band]:
    """Error against a quantity in bands.

    Args:
        errors: (N,) [m]; infinity: missed.
        values: The quantity (N,), such as visible fraction or speed.
        edges: Rising limits of the bands.
    """
    index, bands = band_indices(values, edges), []
    for number, (low, high) in enumerate(pairwise(edges)):
        inside = errors[index == number]
        found = inside[inside < LIMIT]
        recall = len(found) / len(inside) if len(inside) else float("nan")
        median = float(np.median(found)) if len(found) else float("nan")
        bands.append(Band(low, high, len(inside), exact_auc(inside), recall, median))
    return bands
