"""Piles at rest that vibrate: known velocities."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from synpick_warp.apps.statistics.rest import Rest, RestCounts

STEP, WINDOWS = 2e-3, 5
TIME = STEP * np.arange(round(WINDOWS * 0.2 / STEP))
HUM = np.sin(2 * np.pi * 50.0 * TIME)
"""50 Hz."""


def count(speed: np.ndarray, **others: Any) -> Rest | None:
    """Result of an episode in which one of two objects has these speeds [m/s] along x; a third is not in the scene."""
    velocity = np.zeros((len(TIME), 3, 3), np.float32)
    velocity[:, 1, 0], velocity[:, 2] = speed, np.nan
    steps = {"velocity": velocity, "attached": np.zeros((len(TIME), 3), bool), "gripper_contact_load": np.zeros((len(TIME), 2))}
    counts, merged = RestCounts(), RestCounts()
    counts.add_episode(SimpleNamespace(steps={**steps, **others}), STEP)
    merged.merge(counts)
    return merged.result()


@pytest.mark.parametrize(
    ("speed", "windows", "vibrating"),
    [
        (0.0 * TIME, 5, 0),
        (0.006 * HUM, 5, 5),
        (0.006 * HUM + 0.001, 5, 5),
        (0.004 * HUM, 5, 0),
        (0.006 * HUM * (TIME < 0.4), 5, 2),
        (0.1 * HUM * np.exp(-TIME / 0.02), 5, 0),
        (0.006 * HUM + 0.02 * (TIME < 0.2), 4, 4),
    ],
)
def test_windows_that_vibrate_are_counted(speed, windows, vibrating):
    """To and fro without decay; objects that drift or are shaken once are no pile at rest that vibrates."""
    assert count(speed) == Rest(windows, vibrating)


def test_what_the_gripper_does_is_no_rest():
    pressed = np.zeros((len(TIME), 2))
    pressed[150, 1] = 3.0
    assert count(0.006 * HUM, gripper_contact_load=pressed) == Rest(4, 4)
    assert count(0.006 * HUM, attached=np.ones((len(TIME), 3), bool)) is None
