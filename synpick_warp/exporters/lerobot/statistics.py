"""Statistics of features as LeRobot has them: minimum, maximum, mean, standard deviation, count and quantiles, of episodes and of all.

Those of numbers are merged as LeRobot does it: quantiles of all are means of the episodes', weighted by frames. Those of colours follow
from histograms, which add up exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from synpick_warp.system.linear_algebra import dot

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""LeRobot's names and values."""
_WHITE = 255.0

Statistics = dict[str, np.ndarray]


def describe_numbers(values: np.ndarray) -> Statistics:
    """Statistics of each component of values (frame, component), over frames."""
    numbers = values.astype(np.float64)
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=0)
    return {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def merge_numbers(total: Statistics, more: Statistics) -> Statistics:
    """Statistics of two sets of frames together; quantiles are weighted means."""
    count = total["count"] + more["count"]
    share = more["count"] / count
    mean = total["mean"] + share * (more["mean"] - total["mean"])
    spread = total["std"] ** 2 * (1 - share) + more["std"] ** 2 * share + share * (1 - share) * (more["mean"] - total["mean"]) ** 2
    return {
        "min": np.minimum(total["min"], more["min"]),
        "max": np.maximum(total["max"], more["max"]),
        "mean": mean,
        "std": np.sqrt(spread),
        "count": count,
        **{name: (1 - share) * total[name] + share * more[name] for name in QUANTILES},
    }


def describe_levels(levels: np.ndarray, frames: int) -> Statistics:
    """Statistics of a video's channels, from 0 to 1 and of shape (3, 1, 1), from their histograms (3, 256); quantiles are levels."""
    values = np.arange(levels.shape[1]) / _WHITE
    weights = levels / levels.sum(axis=1, keepdims=True)
    mean = dot(weights, values)
    reached = np.cumsum(levels, axis=1)
    channels = {
        "min": values[np.argmax(levels > 0, axis=1)],
        "max": values[levels.shape[1] - 1 - np.argmax(levels[:, ::-1] > 0, axis=1)],
        "mean": mean,
        "std": np.sqrt(np.sum(weights * (values - mean[:, None]) ** 2, axis=1)),
        **{name: values[np.argmax(reached >= fraction * reached[:, -1:], axis=1)] for name, fraction in QUANTILES.items()},
    }
    return {**{name: value.reshape(-1, 1, 1) for name, value in channels.items()}, "count": np.array([frames])}


def to_json(statistics: Statistics) -> dict[str, Any]:
    """Statistics as lists, for JSON."""
    return {name: value.tolist() for name, value in statistics.items()}
