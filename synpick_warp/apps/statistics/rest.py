"""Limit cycles of piles at rest: windows of the step log in which the gripper touches nothing, and those in which an object vibrates."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from synpick_warp.apps.statistics.counting import Counts
from synpick_warp.dataset.reading import Episode

WINDOW = 0.2
"""Length of a window [s]."""
DRIFT = 1.5e-3
"""Mean speed of an object at rest, at most [m/s]: 0.1 mm in a tick of 1/15 s, as `settle.rest_threshold`."""
AMPLITUDE = 5e-3
"""Velocity amplitude about the mean, in both halves of a window, above which an object vibrates [m/s]: 30 µm at 50 Hz are 9 mm/s."""
ARRAYS = ("velocity", "attached", "gripper_contact_load")
"""Arrays of the step log that are read."""


@dataclass(frozen=True)
class Rest:
    """Windows of piles at rest, and those in which an object vibrates without decay."""

    windows: int
    vibrating: int


@dataclass
class RestCounts(Counts):
    """Accumulator of `Rest`."""

    windows: Counter[str] = field(default_factory=Counter)

    def add_episode(self, episode: Episode, step: float) -> None:
        """Count the windows of an episode, if steps were recorded; `step` is the time from row to row [s]."""
        length = round(WINDOW / step)
        if length < 2 or any(name not in episode.steps for name in ARRAYS):
            return
        velocity, attached, load = (episode.steps[name] for name in ARRAYS)
        for first in range(0, velocity.shape[0] - length + 1, length):
            rows = slice(first, first + length)
            if np.any(load[rows]) or np.any(attached[rows]):
                continue
            at_rest, vibrates = judge_window(np.asarray(velocity[rows]))
            self.windows["at rest"] += int(at_rest)
            self.windows["vibrating"] += int(at_rest and vibrates)

    def result(self) -> Rest | None:
        """Numbers of windows; None: there is none."""
        return Rest(self.windows["at rest"], self.windows["vibrating"]) if self.windows["at rest"] else None


def judge_window(velocity: np.ndarray) -> tuple[bool, bool]:
    """Judge a window of velocities (step, instance, axis) [m/s], NaN where an instance is not in the scene.

    Returns:
        Whether all objects are at rest on average, and whether one vibrates in both halves of the window.
    """
    there = velocity[:, np.isfinite(velocity).all(axis=(0, 2))]
    mean = there.mean(axis=0, keepdims=True)
    amplitude = np.linalg.norm(there - mean, axis=2)
    halves = np.array_split(amplitude, 2)
    vibrates = (np.minimum(*(half.max(axis=0) for half in halves)) > AMPLITUDE).any()
    return bool((np.linalg.norm(mean, axis=2) <= DRIFT).all()), bool(vibrates)
