"""Distribution of deviations, by rule and object: median, 95th percentile, largest; what `validate --tolerance` reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from synpick_warp.apps.validation.registry import UNITS, Tolerance, load_rules
from synpick_warp.errors import ConfigError, format_value


class Distribution(NamedTuple):
    """Distribution of the deviations of one rule over the instances of an object, or of all."""

    rule: str
    obj_id: int | None
    """None: all objects."""
    unit: str
    instances: int
    median: float
    percentile_95: float
    largest: float


def distributions(deviations: Mapping[tuple[str, int], Sequence[float]]) -> list[Distribution]:
    """Distributions of deviations by (rule, obj_id): of each rule over all objects, then over each, in the order of the rules."""
    found = []
    for item in load_rules().values():
        parts = {obj_id: np.array(values) for (rule, obj_id), values in sorted(deviations.items()) if rule == item.name}
        if parts:
            every = {None: np.concatenate(list(parts.values()))} | parts
            found += [Distribution(item.name, obj_id, item.unit, len(part), *_summarize(part)) for obj_id, part in every.items()]
    return found


def _summarize(values: np.ndarray) -> tuple[float, float, float]:
    """Median, 95th percentile and maximum."""
    return float(np.median(values)), float(np.quantile(values, 0.95)), float(values.max())


def parse_tolerance(text: str) -> Tolerance:
    """Parse the tolerance MM,PX.

    Raises:
        ConfigError: The text is not two numbers above 0.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(UNITS) or not all(np.isfinite(value) and value > 0.0 for value in values):
        raise ConfigError(f"--tolerance is {format_value(text)}; allowed: millimetres, and pixels, above 0, such as 15,3")
    return Tolerance(*values)
