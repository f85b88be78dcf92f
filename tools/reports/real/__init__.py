"""Sim-to-real transfer of segmentation and detection: training on streams alone, scores on photographs, an ablation study."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

OBJECT = "object"
"""Part of the rows about single objects."""


def interval(values: Sequence[float]) -> str:
    """95 % confidence interval of the mean over seeds (Student's t), formatted; two values are listed, one gives an empty string."""
    if len(values) < 3:
        return f"({values[0]:.3g}, {values[1]:.3g})" if len(values) == 2 else ""
    reach = float(stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return f"({np.mean(values) - reach:.3g} to {np.mean(values) + reach:.3g})"
