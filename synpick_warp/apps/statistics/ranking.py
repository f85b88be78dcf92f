"""ROC AUC, calibration and cluster bootstrap intervals of scores that predict binary outcomes, with sample weights.

Fawcett, An introduction to ROC analysis, 2006; expected calibration error: Naeini et al., 2015; cluster bootstrap: Field and Welsh, 2007.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

BINS = 10
"""Bins of a calibration curve, of equal width from 0 to 1."""
DRAWS = 1000
"""Bootstrap resamples."""
_LEVELS = (2.5, 97.5)
"""Percentiles of a 95 % interval."""


@dataclass(frozen=True)
class Interval:
    """Estimate with its 95 % confidence interval; NaN: undefined, as an AUC without failures."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Scored:
    """Sample of a binary predictor: scores with outcomes, weights and clusters.

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
        """Dense ranking of the scores: number of distinct scores, and the rank of each sample, ascending from 0 (sample) int."""
        values, rank = np.unique(self.score, return_inverse=True)
        return len(values), rank

    def select(self, kept: np.ndarray) -> Scored:
        """Subset by a mask (sample) bool; clusters keep their indices."""
        return Scored(self.score[kept], self.outcome[kept], self.weight[kept], self.cluster[kept])


def weighted_auc(scored: Scored, weight: np.ndarray | None = None) -> float:
    """ROC AUC by the weighted Mann-Whitney statistic: probability that a success outscores a failure; ties count half.

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
class CalibrationCurve:
    """Calibration curve (reliability diagram) by bin of the score."""

    count: np.ndarray
    """(bin) int."""
    predicted: np.ndarray
    """Weighted mean score (bin); NaN here and below: the bin is empty."""
    observed: np.ndarray
    """Weighted success rate (bin)."""
    low: np.ndarray
    """Lower end of the 95 % interval of `observed` (bin)."""
    high: np.ndarray
    """Upper end of that interval (bin)."""
    error: Interval
    """Expected calibration error: weighted mean of |observed - predicted| over bins."""

    def bins(self) -> Iterator[tuple[float, ...]]:
        """Count, mean score, success rate, and the ends of its interval, of each bin."""
        yield from zip(self.count, self.predicted, self.observed, self.low, self.high, strict=True)


def calibrate(scored: Scored, draws: int = DRAWS) -> CalibrationCurve:
    """Calibration curve of scores from 0 to 1, read as probabilities, with cluster bootstrap intervals."""
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
    return CalibrationCurve(np.bincount(place, minlength=BINS), mean, value[:-1], low[:-1], high[:-1], error)


def estimate(scored: Scored, statistic: Callable[[Scored, np.ndarray], float], draws: int = DRAWS) -> Interval:
    """Estimate of a statistic of samples and weights, such as `weighted_auc`, with its cluster bootstrap interval."""
    value, low, high = bootstrap(scored, lambda weight: np.array([statistic(scored, weight)]), draws)
    return Interval(float(value[0]), float(low[0]), float(high[0]))


def bootstrap(
    scored: Scored, statistic: Callable[[np.ndarray], np.ndarray], draws: int = DRAWS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cluster bootstrap, percentile intervals: whole clusters are drawn with replacement; k draws multiply a cluster's weights by k.

    Args:
        scored: The samples.
        statistic: Function of weights (sample) that returns an array of fixed shape.
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
