"""Several cups on one tool: the share of the load that each bears, by statics; misses, breaks and a common valve."""

from __future__ import annotations

import numpy as np
import pytest

from tests.sim.test_cup_rays import GOOD, POOR, RAYS, Cups, below
from tests.worlds.hanging import Hanging

GRAVITY = 9.81
ARM = 0.04
SQUARE = [[ARM, ARM], [-ARM, ARM], [-ARM, -ARM], [ARM, -ARM]]
TRIANGLE = [[ARM * np.cos(angle), ARM * np.sin(angle)] for angle in 2 * np.pi * np.arange(3) / 3]
MASS, SIZE = 2.0, (0.2, 0.16, 0.05)
STEPS = 200


def hanging(device, cups, offsets=((0.0, 0.0),), **overrides) -> Hanging:
    """One world per horizontal offset [m] between a box's centre and the axis of the tool, which holds the box by its top face."""
    array = {"gripper__kind": "suction_array", "gripper__cups": [list(map(float, place)) for place in cups]}
    result = Hanging(device, [[MASS]] * len(offsets), [[SIZE]] * len(offsets), **array, **overrides)
    result.start(np.array([[[*offset, -SIZE[2] / 2]] for offset in offsets]))
    return result


def loads(cups, offset, held) -> np.ndarray:
    """Loads [N] of linear springs at the cups that hold: a plane over their places, with the weight's force and moments."""
    places = np.asarray(cups, float)[held]
    basis = np.column_stack([np.ones(len(places)), places])
    result = np.zeros(len(cups))
    result[held] = basis @ (np.linalg.pinv(basis.T @ basis) @ np.array([1.0, *offset])) * MASS * GRAVITY
    return result


@pytest.mark.parametrize("cups", [[[0.0, 0.0]], SQUARE[::2], TRIANGLE, SQUARE, [*SQUARE, [0.0, 0.0]]])
def test_cups_about_the_middle_of_a_box_bear_equal_shares(device, cups):
    world = hanging(device, cups)
    largest = world.run(STEPS)[-1, 0, 0]
    np.testing.assert_allclose(world.seals.cup_force.numpy()[0], MASS * GRAVITY / len(cups), rtol=0.01)
    assert largest == world.seals.cup_force.numpy().max()


PLACES = [
    ((0.01, 0.005), [0, 1, 2, 3]),
    ((-0.015, 0.0), [0, 1, 2, 3]),
    ((-0.01, 0.01), [0, 1, 2]),
    ((0.01, -0.01), [0, 2, 3]),
    ((0.0, 0.0), [0, 2]),
]
"""Offset of a box's centre, and cups that hold it."""


@pytest.mark.parametrize("breaks", [False, True], ids=["missed", "broken"])
def test_loads_balance_the_moments_where_cups_miss_or_have_broken_off(device, breaks):
    """Cups that never held, and cups that break off in the first steps, leave the same loads to the others."""
    expected = np.array([loads(SQUARE, offset, held) for offset, held in PLACES])
    np.testing.assert_allclose(expected.sum(axis=1), MASS * GRAVITY)
    bits = [[sum(1 << cup for cup in held)] for _, held in PLACES]
    world = hanging(device, SQUARE, [offset for offset, _ in PLACES])
    if breaks:
        world.seals.break_force.assign(np.array([np.where(np.isin(np.arange(4), held), 1e3, 1e-3) for _, held in PLACES]))
    else:
        world.seals.attached.assign(np.array(bits))
    world.run(STEPS)
    assert world.seals.attached.numpy().tolist() == bits
    np.testing.assert_allclose(world.seals.cup_force.numpy(), expected, atol=0.01 * MASS * GRAVITY)


@pytest.mark.parametrize(("valve", "held"), [("each", 0b0111), ("common", 0)])
def test_where_one_seal_of_a_common_valve_breaks_the_others_are_poor(device, valve, held):
    world = hanging(device, SQUARE, gripper__valve=valve)
    world.seals.break_force.assign(np.array([[40.0, 40.0, 40.0, 1.0]]))
    world.run(STEPS)
    assert world.seals.attached.numpy().tolist() == [[held]]
    assert (world.bodies()[0][0, 2, 2] < 0.5) == (held == 0)


@pytest.mark.parametrize(("valve", "sealed"), [(0, 0b0110), (1, 0)])
def test_one_leaking_cup_spoils_a_common_valve_alone(device, valve, sealed):
    """The plate ends half a ring's radius beyond the middle of cups 0 and 3; seven of their ten rays hit."""
    cups = Cups(device, cups=SQUARE)
    cups.scene.cups.common_valve = valve
    cups.put(0, 2, 0, below(0.01) - [0.15 - ARM - 0.005, 0.0, 0.0])
    assert cups.cast() == ([2 * RAYS + 14], [0b100])
    assert cups.attempts.hits.numpy()[0, 1] == sealed
    assert cups.attached() == [[0, 0, 0b1111, 0]]
    assert cups.seals.break_force.numpy()[0].tolist() == [GOOD if sealed >> cup & 1 else POOR for cup in range(4)]


def test_each_cup_holds_what_is_under_it(device):
    """One plate under cups 1 and 2, another under 0 and 3; the tool turned by a quarter lies across both."""
    cups = Cups(device, worlds=2, cups=SQUARE)
    for world in range(2):
        cups.put(world, 0, 0, below(0.01) - [0.15 + 0.002, 0.0, 0.0])
        cups.put(world, 3, 0, below(0.01) - [-0.15 - 0.002, 0.0, 0.0])
    half = np.sqrt(0.5)
    cups.put_cup(1, [0.05, -0.03, 0.1], (0.0, 0.0, half, half))
    assert cups.cast() == ([4 * RAYS] * 2, [0b1001] * 2)
    assert cups.attached() == [[0b0110, 0, 0, 0b1001], [0b0011, 0, 0, 0b1100]]
