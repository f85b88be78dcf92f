"""Evaluation of analytic suction scores against simulated success, by population of candidates and by object.

ROC AUC: Fawcett, An introduction to ROC analysis, 2006; expected calibration error: Naeini et al., 2015; cluster bootstrap: Field and
Welsh, 2007. Samples have weights.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from synpick_warp.codes import Outcome, Share
from synpick_warp.dataset.bop.layout import names_of
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from synpick_warp.system.codecs.tables import Table, parse_columns

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

    def select(self, kept: np.ndarray) -> "Scored":
        """Subset by a mask (sample) bool; clusters keep their indices."""
        return Scored(self.score[kept], self.outcome[kept], self.weight[kept], self.cluster[kept])


def weighted_auc(scored: Scored, weight: np.ndarray | None = None) -> float:
    """ROC AUC by the weighted Mann-Whitney statistic, from 0 to 1: probability that a success outscores a failure; ties count half. NaN
    without successes or failures. `weight`: others (sample) than the samples' own."""
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

    bins: np.ndarray
    """Count, weighted mean score, weighted success rate, and the ends of its 95 % interval (bin, 5); NaN in an empty bin."""
    error: Interval
    """Expected calibration error: weighted mean of |success rate - mean score| over bins."""


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
    return CalibrationCurve(np.column_stack((np.bincount(place, minlength=BINS), mean, value[:-1], low[:-1], high[:-1])), error)


def estimate(scored: Scored, statistic: Callable[[Scored, np.ndarray], float], draws: int = DRAWS) -> Interval:
    """Estimate of a statistic of samples and weights, such as `weighted_auc`, with its cluster bootstrap interval."""
    value, low, high = bootstrap(scored, lambda weight: np.array([statistic(scored, weight)]), draws)
    return Interval(float(value[0]), float(low[0]), float(high[0]))


def bootstrap(
    scored: Scored, statistic: Callable[[np.ndarray], np.ndarray], draws: int = DRAWS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cluster bootstrap, percentile intervals: whole clusters are drawn with replacement; k draws multiply a cluster's weights by k.

    `statistic` maps weights (sample) to an array of fixed shape; resamples are drawn from a fixed seed. Returns values, and lower and upper
    ends of their 95 % intervals, which are NaN with fewer than two clusters.
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


SCORES = ("seal x wrench", "seal", "wrench")
"""Analytic scores; the first is SuctionNet's."""
FACING = 10.0
"""Largest angle between the direction of the press and the surface normal of trials that are pressed along it [°]."""
UNIFORM, FACED, ALL = "uniform over visible pixels, weighted", f"of these, pressed within {FACING:.0f}° of the normal", "all candidates"
"""Populations of trials: the uniform share, with inverse probability weights; its trials that are pressed along the normal, as the analytic
score supposes (the gripper's tilt is limited); and all sampled candidates, unweighted."""
MIN_OUTCOMES = 5
"""Fewest successes, and fewest failures, of an object for which an AUC is estimated."""
_KEPT = ("state", "candidate", "repeat", "share", "weight", "obj_id", "seal", "wrench", "outcome", "success")


@dataclass(frozen=True)
class ScoreFigures:
    """Success rate of a population of trials, with ROC AUC and calibration of a score that predicts it."""

    score: str
    population: str
    trials: int
    success: Interval
    """Success rate, weighted as its population."""
    auc: Interval
    calibration: CalibrationCurve


@dataclass(frozen=True)
class ObjectFigures:
    """Success rate of trials on an object, with ROC AUC of SuctionNet's score; all candidates, unweighted."""

    obj_id: int
    name: str
    trials: int
    success: Interval
    auc: Interval | None
    """None: fewer than MIN_OUTCOMES successes or failures."""


@dataclass(frozen=True)
class PickFigures:
    """Evaluation of the picks of a data set."""

    episodes: int
    states: int
    candidates: int
    trials: int
    """Trials that count: with an outcome, and sampled, not the episode's own."""
    left_out: int
    """Trials that do not: own grasps, or ended by the simulation."""
    scores: tuple[ScoreFigures, ...]
    objects: tuple[ObjectFigures, ...]


def collect_picks(data_set: DataSet) -> tuple[np.ndarray, int]:
    """Concatenate the trials of all episodes; returns them, and the number of episodes with trials.

    The structured array (trial) also has `cluster`, a number of the state, and `angle` between press and surface normal [°]. Raises
    DatasetError if there are no trials, or a table is damaged.
    """
    parts, states, episodes = [], 0, 0
    for episode in data_set.values():
        picks = episode.picks
        if not len(picks):
            continue
        part = np.empty(len(picks), [(name, picks.dtype[name]) for name in _KEPT] + [("cluster", np.int64), ("angle", np.float64)])
        for name in _KEPT:
            part[name] = picks[name]
        along = -(picks["approach"].astype(np.float64) * picks["normal"]).sum(axis=1)
        part["angle"] = np.degrees(np.arccos(np.clip(along, -1.0, 1.0)))
        _, order = np.unique(picks["state"], return_inverse=True)
        part["cluster"] = states + order
        states, episodes = states + int(order.max()) + 1, episodes + 1
        parts.append(part)
    if not parts:
        raise DatasetError(f"{data_set.folder} has no trials; its episodes never chose a grasp")
    return np.concatenate(parts), episodes


def evaluate_picks(trials: np.ndarray, episodes: int, names: dict[int, str], draws: int = DRAWS) -> PickFigures:
    """Evaluate the analytic scores on trials of `collect_picks`, by population and by object, with cluster bootstrap intervals over states.

    The figures have neither scores nor objects if no trial of a sampled candidate has an outcome, as with picks.candidates = 1.
    """
    counted = trials[(trials["share"] != Share.OWN) & (trials["outcome"] != Outcome.NONE)]
    both = {"seal x wrench": counted["seal"] * counted["wrench"], "seal": counted["seal"], "wrench": counted["wrench"]}
    uniform, weight = counted["share"] == Share.UNIFORM, counted["weight"]
    faced = uniform & (counted["angle"] <= FACING)
    populations = {UNIFORM: (uniform, weight), FACED: (faced, weight), ALL: (np.ones(len(counted), bool), np.ones(len(counted)))}
    if faced.sum() == uniform.sum():
        del populations[FACED]  # It is the same as UNIFORM.
    figures = []
    for population, (kept, weight) in populations.items():
        for score, values in both.items() if kept.any() else ():
            scored = Scored(
                values[kept].astype(np.float64), counted["success"][kept], weight[kept].astype(np.float64), counted["cluster"][kept]
            )
            rate, auc = estimate(scored, success_rate, draws), estimate(scored, weighted_auc, draws)
            figures.append(ScoreFigures(score, population, len(scored.score), rate, auc, calibrate(scored, draws)))
    whole = Scored(both[SCORES[0]].astype(np.float64), counted["success"], np.ones(len(counted)), counted["cluster"])
    candidates = len(np.unique(counted[["cluster", "candidate"]]))
    states = len(np.unique(counted["cluster"]))
    objects = tuple(_by_object(counted, whole, names, draws))
    return PickFigures(episodes, states, candidates, len(counted), len(trials) - len(counted), tuple(figures), objects)


def _by_object(trials: np.ndarray, scored: Scored, names: dict[int, str], draws: int) -> Iterator[ObjectFigures]:
    """Figures of each object, in the order of obj_id."""
    for obj_id in np.unique(trials["obj_id"]).tolist():
        own = scored.select(trials["obj_id"] == obj_id)
        enough = min(own.outcome.sum(), (~own.outcome).sum()) >= MIN_OUTCOMES
        auc = estimate(own, weighted_auc, draws) if enough else None
        yield ObjectFigures(obj_id, names.get(obj_id, f"object {obj_id}"), len(own.score), estimate(own, success_rate, draws), auc)


def find_picks(data_set: DataSet, draws: int = DRAWS) -> PickFigures | None:
    """Collect and evaluate the picks of a data set; None: it has none. Raises DatasetError if a table is damaged."""
    if data_set.found is not None or "picks" not in data_set.config.bake.formats or not any(len(each.picks) for each in data_set.values()):
        return None
    trials, episodes = collect_picks(data_set)
    return evaluate_picks(trials, episodes, names_of(data_set), draws)


_RATE = "success:.1% success_low:.1%:from success_high:.1%:to"
_AUC = "auc:.3f:AUC auc_low:.3f:from auc_high:.3f:to"
_ERROR = "ece:.3f:calibration_error ece_low:.3f:from ece_high:.3f:to"
"""Columns of an estimate with its interval."""


def picks_tables(figures: PickFigures) -> tuple[Table, ...]:
    """Format the figures as tables: scores, calibration curve of SuctionNet's score, objects."""
    scores = [
        (each.population, each.score, each.trials, *_values(each.success), *_values(each.auc), *_values(each.calibration.error))
        for each in figures.scores
    ]
    bins = [
        (each.population, f"{number / BINS:.1f} to {(number + 1) / BINS:.1f}", int(count), *map(_known, shares))
        for each in figures.scores
        if each.score == SCORES[0]
        for number, (count, *shares) in enumerate(each.calibration.bins)
    ]
    objects = [
        (each.obj_id, each.name, each.trials, *_values(each.success), *(_values(each.auc) if each.auc else (None,) * 3))
        for each in figures.objects
    ]
    by_score = parse_columns(f"candidates score trials:, {_RATE} {_AUC} {_ERROR}")
    by_bin = parse_columns(f"candidates score trials:, mean_score:.3f {_RATE}")
    by_object = parse_columns(f"obj_id:d name trials:, {_RATE} {_AUC}")
    return (
        Table("pick_scores", "Simulated success by analytic scores, 95 % intervals over states", by_score, scores),
        Table("pick_calibration", "Calibration of seal x wrench", by_bin, bins),
        Table("pick_objects", "By object: all candidates, seal x wrench", by_object, objects),
    )


def _values(interval: Interval) -> tuple[float | None, ...]:
    """Value and ends of an interval, None where undefined."""
    return tuple(map(_known, (interval.value, interval.low, interval.high)))


def _known(value: Any) -> float | None:
    """A number; None for NaN."""
    return None if np.isnan(value) else float(value)
