"""The depth sensor's settings as its kernel takes them."""

from __future__ import annotations

import math
from typing import Any

from synpick_warp.configs.schema import Config
from synpick_warp.kernels.render.images.depth_sensor import SensorRules


def sensor_rules(config: Config) -> Any:
    """The struct `SensorRules`."""
    settings = config.depth_sensor
    rules = SensorRules()
    for name in ("baseline", "disparity_step", "noise", "noise_growth", "noise_distance", "noise_angle", "lateral_noise"):
        setattr(rules, name, getattr(settings, name))
    rules.seed = config.bake.seed
    rules.near, rules.far = settings.distances
    rules.grazing_cosine = math.cos(math.radians(settings.grazing_angle))
    rules.edge_width, rules.edge_step = settings.edge_width, settings.edge_step
    rules.shadows = int(settings.shadows)
    rules.counts_per_meter = 1000.0 / config.bop.depth_scale
    return rules
