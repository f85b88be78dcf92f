"""Moments of choice: device and host agree on the states that are saved, also after a first look without a target."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.sim.trials import list_choices_kernel
from synpick_warp.kernels.state import Attempts, Worlds
from synpick_warp.kernels.structs import CatalogData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.choices import ChoiceReader
from tests.worlds.kernel_worlds import filled

STATES, ROWS, OBJECTS = 2, 8, 6
"""Saved states of an episode, rows of the ring buffer, and labelled objects: the stride is 3."""


def list_choices(device, attempts: list[int], has_target: list[bool]) -> list[tuple[int, int]]:
    """(row, attempt) of the states that the kernel lists, of attempts of one world."""
    catalog = CatalogData()
    catalog.count = OBJECTS
    stride, following = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    world, found = wp.zeros(ROWS, dtype=int, device=device), []
    for attempt, sees in zip(attempts, has_target, strict=True):
        values = {"phase": Phase.ACT, "task": Task.APPROACH if sees else Task.LOOK, "steps": 0, "attempt": attempt}
        arrays = {name: wp.array([int(value)], dtype=int, device=device) for name, value in values.items()}
        index = wp.array(np.arange(OBJECTS)[None], dtype=int, device=device)
        state = filled(Worlds(), {"phase": arrays.pop("phase"), "catalog_index": index})
        given = {"catalog": catalog, "states": STATES, "state": state, "attempts": filled(Attempts(), arrays)}
        launch(list_choices_kernel, 1, **given, stride=stride, next=following, world=world)
        found += [(int(row), attempt) for row in np.flatnonzero(world.numpy() == 0)]
    return found


def read_choices(attempts: list[int], has_target: list[bool]) -> list[tuple[int, int]]:
    """(row, attempt) of the states that the host reads from reports of the same ticks."""
    layout = SimpleNamespace(worlds=1)
    reader = ChoiceReader(SimpleNamespace(states=STATES, rows=ROWS, simulation=SimpleNamespace(layout=layout)), OBJECTS)
    found = []
    for attempt, sees in zip(attempts, has_target, strict=True):
        columns = {"phase": Phase.ACT, "task": Task.LOOK, "attempt": attempt - 1}
        report = SimpleNamespace(
            column=lambda name, columns=columns: np.array([int(columns.get(name, 0))]),
            plan=SimpleNamespace(target=np.array([0 if sees else -1])),
            catalog_index=np.arange(OBJECTS)[None],
        )
        found += [(choice.row, attempt) for choice in reader.read(report)]
    return found


@pytest.mark.parametrize(("has_target", "expected"), [([True] * 7, [(0, 0), (1, 3)]), ([False] + [True] * 6, [(0, 3)])])
def test_every_third_attempt_is_a_moment_of_choice(device, has_target, expected):
    attempts = list(range(7))
    assert list_choices(device, attempts, has_target) == expected
    assert read_choices(attempts, has_target) == expected
