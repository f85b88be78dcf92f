"""Networks that are trained on streams alone, scored on photographs: training, scores, a detector, ablations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats


def interval(values: Sequence[float]) -> str:
    """95 % interval of the mean over seeds by Student's t, as text; empty for fewer than two."""
    if len(values) < 2:
        return ""
    reach = float(stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return f"({np.mean(values) - reach:.3g} to {np.mean(values) + reach:.3g})"
