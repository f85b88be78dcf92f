"""Randomized looks: what episodes have drawn of each parameter, and how many distractors."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from synpick_warp.apps.statistics.counting import Counts
from synpick_warp.apps.statistics.records import LookFacts, Looks

DIGITS = 2
"""Significant digits of the values that are counted: quantiles are within 5 %, and the number of distinct values stays small."""
QUANTILES = (0.05, 0.5, 0.95)
"""Quantiles of the drawn values."""
_EPISODE, _COUNT, _INSTANCE = "episode", "distractors", "instance"
_CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class LookStatistics:
    """Values that episodes have drawn of a parameter of a part: their number, and QUANTILES."""

    part: str
    """episode, bin, table, background, object or distractor."""
    parameter: str
    """As in `episodes.jsonl`; a channel of a colour behind a dot."""
    draws: int
    quantiles: tuple[float, ...]


@dataclass
class LookCounts(Counts):
    """Accumulator of `LookStatistics`: draws by part, parameter and rounded value."""

    draws: Counter[tuple[str, str, float]] = field(default_factory=Counter)

    def add_episode(self, looks: Looks) -> None:
        """Count what an episode has drawn."""
        for name, value in looks.items():
            if isinstance(value, dict):
                self._add_row(name, value)
            elif isinstance(value, list):
                for row in value:
                    self._add_row(name.removesuffix("s"), row)
            else:
                self._add(_EPISODE, name, value)
            if name == _COUNT and isinstance(value, list):
                self._add(_EPISODE, _COUNT, len(value))

    def _add_row(self, part: str, row: LookFacts) -> None:
        """Count the parameters of a body."""
        for name, value in row.items():
            if isinstance(value, list):
                for channel, one in zip(_CHANNELS, value, strict=False):
                    self._add(part, f"{name}.{channel}", one)
            elif not isinstance(value, str) and name != _INSTANCE:
                self._add(part, name, value)

    def _add(self, part: str, parameter: str, value: float) -> None:
        """Count a value, rounded to DIGITS."""
        places = DIGITS - 1 - math.floor(math.log10(abs(value))) if value else 0
        self.draws[part, parameter, round(float(value), places)] += 1

    def result(self) -> tuple[LookStatistics, ...]:
        """Statistics of each part and parameter, sorted; none: looks are not randomized."""
        values: dict[tuple[str, str], list[tuple[float, int]]] = {}
        for (part, parameter, value), count in self.draws.items():
            values.setdefault((part, parameter), []).append((value, count))
        result = []
        for (part, parameter), pairs in sorted(values.items()):
            drawn, counts = np.array(sorted(pairs)).T
            total = np.cumsum(counts)
            quantiles = tuple(float(drawn[np.searchsorted(total, share * total[-1])]) for share in QUANTILES)
            result.append(LookStatistics(part, parameter, int(total[-1]), quantiles))
        return tuple(result)
