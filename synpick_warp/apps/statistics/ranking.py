"""Area under the ROC curve (AUC), calibration and bootstrap intervals of scores that predict binary outcomes, with sample weights.

Fawcett, An introduction to ROC analysis, 2006; expected calibration error: Naeini et al., 2015; cluster bootstrap: Field and Welsh, 2007.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

BINS = 10
"""Bins of a calibration curve, of equal width from 0 to 1."""
DRAWS = 1000
"""Bootstrap samples."""
_LEVELS = (2.5, 97.5)
"""Percentiles of a 95 % interval."""


@dataclass(frozen=True)
class Interval:
    """Estimate with its 95 % interval; NaN: undefined, as an AUC without failures."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Scored:
    """Scores of samples with their outcomes, weights and clusters.

    Samples of a cluster depend on each other, such as picks from one state; clusters are independent.
    """

    score: np.ndarray
    """(sample) float."""
    outcome: np.ndarray
    """(sample) bool."""
    weight: np.ndarray
    """(sample) float, 0 or more."""
    cluster: np.ndarray
    """Index of the cluster (sample) int, from 0."""

    @cached_property
    def ties(self) -> tuple[int, np.ndarray]:
        """Number of distinct scores, and the rank of each sample's among them, ascending (sample) int."""
        values, rank = np.unique(self.score, return_inverse=True)
        return len(values), rank

    def select(self, kept: np.ndarray) -> Scored:
        """The samples of a mask; clusters keep their indices."""
        return Scored(self.score[kept], self.outcome[kept], self.weight[kept], self.cluster[kept])


def weighted_auc(scored: Scored, weight: np.ndarray | None = None) -> float:
    """Area under the ROC curve by the rank statistic: probability that a success has a higher score than a failure; ties count half.

    Args:
        scored: The samples.
        weight: Other weights (sample); None: their own.

    Returns:
        From 0 to 1; NaN without successes or failures.
    """
    weight = scored.weight if weight is None else weight
    count, rank = scored.ties
    gained, lost = (np.bincount(rank, weight * side, count) for side in (scored.outcome, ~scored.outcome))
    pairs = gained.sum() * lost.sum()
    return float(gained @ (np.cumsum(lost) - lost / 2.0) / pairs) if pairs > 0.0 else float("nan")


def success_rate(scored: Scored, weight: np.ndarray | None = None) -> float:
    """Weighted share of successes; NaN without samples. Arguments as of `weighted_auc`."""
    weight = scored.weight if weight is None else weight
    return float(weight @ scored.outcome / weight.sum()) if weight.sum() > 0.0 else float("nan")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration curve: by bins of the score the number of samples, the mean score, and the share of successes; and its error."""

    count: np.ndarray
    """(bin) int."""
    predicted: np.ndarray
    """Weighted mean of the scores (bin); NaN: empty, here and below."""
    observed: np.ndarray
    """Weighted share of successes (bin)."""
    low: np.ndarray
    """Lower end of its 95 % interval (bin)."""
    high: np.ndarray
    """Upper end (bin)."""
    error: Interval
    """Expected calibration error: weighted mean distance between the two."""


def calibrate(scored: Scored, draws: int = DRAWS) -> Calibration:
    """Calibration curve of scores from 0 to 1, taken for probabilities, with bootstrap intervals over clusters."""
    place = np.clip((scored.score * BINS).astype(np.int64), 0, BINS - 1)

    def sums(weight: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(place, weight * values, BINS) for values in (1.0, scored.score, scored.outcome)])

    def curve(weight: np.ndarray) -> np.ndarray:
        total, predicted, observed = sums(weight)
        with np.errstate(invalid="ignore"):
            return np.concatenate((observed / total, [np.abs(predicted - observed).sum() / total.sum()]))

    with np.errstate(invalid="ignore"):
        total, predicted, _ = sums(scored.weight)
        mean = predicted / total
    value, low, high = bootstrap(scored, curve, draws)
    error = Interval(float(value[-1]), float(low[-1]), float(high[-1]))
    return Calibration(np.bincount(place, minlength=BINS), mean, value[:-1], low[:-1], high[:-1], error)


def estimate(scored: Scored, statistic: Callable[[Scored, np.ndarray], float], draws: int = DRAWS) -> Interval:
    """A statistic of samples and weights, such as `weighted_auc`, with its bootstrap interval over clusters."""
    value, low, high = bootstrap(scored, lambda weight: np.array([statistic(scored, weight)]), draws)
    return Interval(float(value[0]), float(low[0]), float(high[0]))


def bootstrap(
    scored: Scored, statistic: Callable[[np.ndarray], np.ndarray], draws: int = DRAWS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Percentile intervals by resampling whole clusters with replacement; a cluster that is drawn k times counts k times.

    Args:
        scored: The samples.
        statistic: Numbers that follow from weights (sample), of any one shape.
        draws: Number of resamples, from a fixed seed.

    Returns:
        Values, and lower and upper ends of their 95 % intervals, which are NaN with fewer than two clusters.
    """
    value = statistic(scored.weight)
    names, cluster = np.unique(scored.cluster, return_inverse=True)
    if len(names) < 2:
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    generator = np.random.default_rng(0)
    drawn = np.stack(
        [statistic(scored.weight * generator.multinomial(len(names), np.full(len(names), 1.0 / len(names)))[cluster]) for _ in range(draws)]
    )
    ends = np.full((2, *value.shape), np.nan)
    known = ~np.isnan(drawn).all(axis=0)
    ends[:, known] = np.nanpercentile(drawn[:, known], _LEVELS, axis=0)
    return value, ends[0], ends[1]
