"""Parameter sweep of the tracking filter: the score of each mode for each weight alpha, and the best alpha.

The paper compares alpha 0.05 and 0.2 (table "Evaluation metrics"): a small alpha averages noise away, and lags behind what moves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.tracking.filtering import check_alpha, filter_poses
from synpick_warp.apps.evaluation.tracking.tracks import find_tracks
from synpick_warp.errors import ConfigError, DatasetError

ScoreFunction = Callable[[PoseTable], float]
"""Score of estimates, larger is better; misses are counted by it, against the truth that it knows."""
SWEEP_ALPHAS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
"""Default weights: the paper's two among them, and 1, which changes nothing."""


@dataclass(frozen=True, eq=False)
class AlphaSweep:
    """Scores of a sweep over the tracking filter's weight alpha, by mode (M) and alpha (A), and unfiltered by mode."""

    modes: tuple[str, ...]
    """Names of the rows, in the order given."""
    alphas: tuple[float, ...]
    """Weights of the new estimate, rising."""
    scores: np.ndarray
    """Score of each mode and alpha (M, A) float64."""
    unfiltered: np.ndarray
    """Score of each mode's estimates as they came (M,) float64."""

    def best(self, mode: str) -> tuple[float, float]:
        """Alpha with the highest score of a mode, and this score; among equal scores the largest alpha, which lags least."""
        row = self.scores[self.modes.index(mode)]
        column = int(np.flatnonzero(row == row.max())[-1])
        return self.alphas[column], float(row[column])

    def rows(self) -> list[dict[str, str | float | bool]]:
        """Rows of the table in long form: mode, alpha, score, gain over the unfiltered score, and whether this alpha is the mode's best."""
        return [
            {"mode": mode, "alpha": alpha, "score": float(score), "gain": float(score - raw), "best": alpha == self.best(mode)[0]}
            for mode, scores, raw in zip(self.modes, self.scores, self.unfiltered, strict=True)
            for alpha, score in zip(self.alphas, scores, strict=True)
        ]


def sweep_alpha(
    tables: Mapping[str, PoseTable],
    score: ScoreFunction | Mapping[str, ScoreFunction],
    alphas: Sequence[float] = SWEEP_ALPHAS,
    *,
    symmetries: Mapping[int, np.ndarray] | None = None,
) -> AlphaSweep:
    """Filter and score the estimates of each mode with each alpha, and score them unfiltered; tracks are found once a mode.

    Args:
        tables: Mode -> its estimates; see `split_by_mode`.
        score: Score function, or one for each mode where misses count against the truth of that mode's scenes only.
        alphas: Weights of the new estimate, above 0 and at most 1, in any order; equal ones count once.
        symmetries: As `filter_poses`.

    Raises:
        ConfigError: No mode, no alpha, an alpha out of range, or a mode without score function.
        DatasetError: A score is not a finite number, or as `filter_poses`.
    """
    weights = tuple(sorted({float(alpha) for alpha in alphas}))
    if not weights or not tables:
        raise ConfigError("a sweep has at least one mode and one alpha; the default alphas are " + ", ".join(map(str, SWEEP_ALPHAS)))
    for alpha in weights:
        check_alpha(alpha)
    functions = dict(score) if isinstance(score, Mapping) else dict.fromkeys(tables, score)
    if missing := [mode for mode in tables if mode not in functions]:
        raise ConfigError(f"mode {missing[0]} has no score function; give one for each of {', '.join(tables)}")
    scores, unfiltered = np.empty((len(tables), len(weights))), np.empty(len(tables))
    for row, (mode, table) in enumerate(tables.items()):
        tracks = find_tracks(table)
        unfiltered[row] = _score(functions[mode], table, mode, "no filter")
        for column, alpha in enumerate(weights):
            filtered = filter_poses(table, alpha, tracks=tracks, symmetries=symmetries)
            scores[row, column] = _score(functions[mode], filtered, mode, f"alpha {alpha}")
    return AlphaSweep(tuple(tables), weights, scores, unfiltered)


def split_by_mode(table: PoseTable, modes: Mapping[int, str]) -> dict[str, PoseTable]:
    """Split estimates by the mode of their scenes.

    Args:
        table: N estimates.
        modes: Scene index -> mode.

    Returns:
        Mode -> its rows, for every mode in `modes`, in order of their first scenes.

    Raises:
        DatasetError: A scene of the table has no mode.
    """
    if unknown := sorted({int(scene) for scene in table.scene} - modes.keys()):
        raise DatasetError(f"scene {unknown[0]} has no mode; give the mode of every scene that has estimates")
    names = dict.fromkeys(modes[scene] for scene in sorted(modes))
    return {name: table.select(np.isin(table.scene, [scene for scene in modes if modes[scene] == name])) for name in names}


def _score(function: ScoreFunction, table: PoseTable, mode: str, setting: str) -> float:
    """Call a score function, and check that it returns a number."""
    value = float(function(table))
    if not math.isfinite(value):
        raise DatasetError(f"the score of mode {mode} with {setting} is {value}; score functions return finite numbers, larger is better")
    return value
