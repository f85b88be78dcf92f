"""Speed limit of free bodies: slow ones are left alone, fast ones are slowed down within a step, whichever have constraint rows for it."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from synpick_warp.scenes import build
from synpick_warp.stages.sim.physics import VELOCITY_LIMIT_FRACTION, Physics
from tests.worlds.hanging import COARSE
from tests.worlds.small_worlds import CUBE, catalog, settings

LIMIT = 4.0
# Velocities at the start [m/s]: without rows, with idle rows, beyond the limit in one axis and in two.
VELOCITIES = np.array([[1.0, 0.5, -0.7], [0.0, 3.0, 0.0], [9.0, 0.0, 1.0], [0.0, -7.0, 6.0]])
PLACE = (0.1, -0.2, 3.0)
HOVER = 1.0


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
    built = build.build_model(config, catalog(CUBE), device)
    physics, worlds = Physics(config.physics, built), len(VELOCITIES)
    first = build.GRIPPER_DOFS
    coordinates, velocities = (array.numpy().reshape(worlds, -1) for array in (physics.state.joint_q, physics.state.joint_qd))
    coordinates[:, 2] = HOVER
    coordinates[:, first : first + 7] = (*PLACE, 0.0, 0.0, 0.0, 1.0)
    velocities[:, first : first + 3] = VELOCITIES
    physics.state.joint_q.assign(coordinates.reshape(-1))
    physics.state.joint_qd.assign(velocities.reshape(-1))
    variant = np.full((worlds, built.layout.bodies_per_world), -1, np.int32)
    variant[:, build.GRIPPER_BODIES] = built.variant[0]
    restarted = wp.array(np.ones(worlds + 1, bool), dtype=bool, device=device)
    physics.load(wp.array(variant.reshape(-1), dtype=wp.int32, device=device), restarted)
    found = []
    for _ in range(2):
        physics.tick(lambda current: None)
        found.append(physics.state.joint_qd.numpy().reshape(worlds, -1)[:, first : first + 3].copy())
    return np.array(found)


def test_the_cases_lie_on_both_sides_of_the_threshold_for_rows():
    assert np.abs(VELOCITIES[0]).max() < VELOCITY_LIMIT_FRACTION * LIMIT < np.abs(VELOCITIES[1]).max() < LIMIT


def test_speeds_along_each_axis_are_limited_in_the_first_step_and_others_are_kept(thrown):
    np.testing.assert_allclose(thrown, np.broadcast_to(np.clip(VELOCITIES, -LIMIT, LIMIT), thrown.shape), atol=1e-3)
