"""One cube a world in the real physics, beside a gripper above the tote."""

from __future__ import annotations

import numpy as np
import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.scenes import build
from synpick_warp.stages.sim.physics import Physics
from tests.worlds.small_worlds import CUBE, catalog

HOVER = 1.0
"""Height of the wrist [m]."""


def place_cubes(config: Config, device: wp.Device, pose: np.ndarray, velocity: np.ndarray | None = None) -> Physics:
    """Build worlds with a cube each.

    Args:
        config: Settings of these worlds.
        device: Device of the simulation.
        pose: Position [m] and quaternion xyzw of the cubes (world, 7).
        velocity: Their linear velocity (world, 3) [m/s]; None: at rest.
    """
    built = build.build_model(config, catalog(CUBE), device)
    physics, worlds, first = Physics(config.physics, built), len(pose), build.GRIPPER_DOFS
    coordinates, velocities = (array.numpy().reshape(worlds, -1) for array in (physics.state.joint_q, physics.state.joint_qd))
    coordinates[:, 2] = HOVER
    coordinates[:, first : first + build.FREE_COORDS] = pose
    if velocity is not None:
        velocities[:, first : first + 3] = velocity
    physics.state.joint_q.assign(coordinates.reshape(-1))
    physics.state.joint_qd.assign(velocities.reshape(-1))
    variant = np.full((worlds, built.layout.bodies_per_world), -1, np.int32)
    variant[:, build.GRIPPER_BODIES] = built.variant[0]
    restarted = wp.array(np.ones(worlds + 1, bool), dtype=bool, device=device)
    physics.load(wp.array(variant.reshape(-1), dtype=wp.int32, device=device), restarted)
    return physics
