"""Benchmark of the environment: attempts per second of whole picks, and ticks per second of twists, with and without pictures.

Its worlds have the settings of the benchmark; as many as --worlds says pick, four times as many twist. Rates are of steps alone: resets,
which simulate piles to rest, are a row of their own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.environment.settings import make_choice
from tools.options import Row

TWISTS = 4
"""Worlds that twist for each that picks: 2,048 by default, as peers publish."""
PILES = 128
"""Different piles of all cases but the first, so that their resets are short."""
SHORT = {"pick.appear_height": 0.1, "pick.lift_height": 0.2}
"""Settings of attempts that begin near the object and end soon, as trials do."""
CASES: tuple[tuple[str, int, dict[str, Any], dict[str, Any]], ...] = (
    ("attempts, state alone", 1, {"action": "point", "obs": ("state",), "piles": None}, {}),
    ("attempts, depth 160x90", 1, {"action": "pixel", "obs": ("depth",)}, {}),
    ("short attempts, depth 160x90", 1, {"action": "pixel", "obs": ("depth",)}, SHORT),
    ("ticks, state alone", TWISTS, {"action": "twist", "obs": ("state",)}, {}),
    ("ticks, depth 64x64", TWISTS, {"action": "twist", "obs": ("depth",), "resolution": (64, 64)}, {}),
    ("ticks, colour and depth 64x64", TWISTS, {"action": "twist", "obs": ("rgb", "depth"), "resolution": (64, 64)}, {}),
)
"""Name, worlds relative to those of the benchmark, what differs from DEFAULTS, and settings."""
DEFAULTS: dict[str, Any] = {
    "task": "pick",
    "resolution": (160, 90),
    "autoreset": "disabled",
    "backend": "warp",
    "seed": 0,
    "max_steps": 10**6,
    "piles": PILES,
    "course": "attempt",
}
SPREAD = 0.15
"""Half width of the square of points that are tried, and their height [m]; most of them end on an object."""
HEIGHT = 0.05


def measure_environment(make: Callable[..., PickingEnvironment], worlds: int, min_seconds: float) -> Iterator[Row]:
    """Measure all cases.

    Args:
        make: `make_picking` with the settings.
        worlds: Environments that pick.
        min_seconds: Time for which steps are repeated, at least [s].
    """
    for name, factor, given, settings in CASES:
        count = factor * worlds
        environment = make(make_choice(**{**DEFAULTS, **given, "num_envs": count}), settings=settings)
        started = time.perf_counter()
        environment.reset(seed=0)
        settled = time.perf_counter() - started
        random = np.random.default_rng(0)
        environment.step(_sample(environment, random))
        steps, started = 0, time.perf_counter()
        while not steps or time.perf_counter() - started < min_seconds:
            environment.step(_sample(environment, random))
            steps += 1
        seconds = time.perf_counter() - started
        yield Row(f"{name}, {count} worlds", steps * count / seconds, "1/s")
        yield Row(f"{name}: a reset of all", settled, "s")
        del environment


def _sample(environment: PickingEnvironment, random: np.random.Generator) -> np.ndarray:
    """Random actions: pixels of the middle of the image, points above the floor, or twists."""
    choice, count = environment.choice, environment.count
    if choice.action == "pixel":
        size = np.array(choice.resolution)
        return random.integers(size // 4, 3 * size // 4, (count, 2))
    if choice.action == "point":
        across = random.uniform(-SPREAD, SPREAD, (count, 2))
        return np.concatenate([across, np.full((count, 1), HEIGHT), np.tile([0.0, 0.0, 1.0], (count, 1))], axis=1)
    return random.uniform(-1.0, 1.0, (count, 6))
