"""Speed limit of free bodies: slow ones are left alone, fast ones are slowed down within a step, whichever have constraint rows for it."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.scenes import build
from synpick_warp.stages.sim.physics import VELOCITY_LIMIT_FRACTION
from tests.worlds.cubes import place_cubes
from tests.worlds.hanging import COARSE
from tests.worlds.small_worlds import settings

LIMIT = 4.0
# Velocities at the start [m/s]: without rows, with idle rows, beyond the limit in one axis and in two.
VELOCITIES = np.array([[1.0, 0.5, -0.7], [0.0, 3.0, 0.0], [9.0, 0.0, 1.0], [0.0, -7.0, 6.0]])
POSE = (0.1, -0.2, 3.0, 0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def thrown(device) -> np.ndarray:
    """Velocity of one cube a world, thrown without gravity far above the tote, after one step and after two (tick, world, 3)."""
    config = settings(
        bake__worlds=len(VELOCITIES),
        arrangement__max_objects=1,
        physics__gravity=0.0,
        physics__guide_height=0.2,
        physics__max_speed=LIMIT,
        **COARSE,
    )
    worlds, first = len(VELOCITIES), build.GRIPPER_DOFS
    physics = place_cubes(config, device, np.tile(POSE, (worlds, 1)), VELOCITIES)
    found = []
    for _ in range(2):
        physics.tick(lambda current: None)
        found.append(physics.state.joint_qd.numpy().reshape(worlds, -1)[:, first : first + 3].copy())
    return np.array(found)


def test_the_cases_lie_on_both_sides_of_the_threshold_for_rows():
    assert np.abs(VELOCITIES[0]).max() < VELOCITY_LIMIT_FRACTION * LIMIT < np.abs(VELOCITIES[1]).max() < LIMIT


def test_speeds_along_each_axis_are_limited_in_the_first_step_and_others_are_kept(thrown):
    np.testing.assert_allclose(thrown, np.broadcast_to(np.clip(VELOCITIES, -LIMIT, LIMIT), thrown.shape), atol=1e-3)
