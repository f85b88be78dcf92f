"""The gripper's joints: fingers turn, cups tilt, and the gripper still moves along the world's axes."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from synpick_warp.scenes import build
from synpick_warp.stages.sim.physics import Physics
from tests.twins.raycast import rotation_of
from tests.worlds.small_worlds import CUBE, catalog, settings

YAW = np.array([0.0, 0.7, -2.5])
TILT = np.array([0.4, 0.4, -1.2])
# Above the tote.
PLACE = np.array([0.1, -0.2, 1.0])
FORCE = np.array([3.0, -2.0, 1.0])
STEPS = 250


@pytest.fixture(scope="module")
def turned(device) -> tuple[Physics, np.ndarray, np.ndarray]:
    """Three grippers, turned between two steps; then tilted and pushed. Poses of finger and cup in the beginning, position at the end."""
    config = settings(
        bake__worlds=3,
        arrangement__max_objects=1,
        physics__steps_per_tick=1,
        physics__gravity=0.0,
        physics__substeps=1,
        physics__guide_height=0.2,
    )
    physics = Physics(config.physics, build.build_model(config, catalog(CUBE), device))
    coordinates = physics.state.joint_q.numpy().reshape(3, -1)
    coordinates[:, : build.GRIPPER_DOFS] = [*PLACE, 0.0]
    physics.state.joint_q.assign(coordinates.reshape(-1))
    physics.refresh_poses()
    force = np.zeros((3, physics.layout.dofs_per_world), np.float32)
    physics.tick(lambda current: None)
    physics.set_yaw(wp.array(YAW, dtype=float, device=device))
    physics.refresh_poses()
    poses = physics.state.body_q.numpy().reshape(3, -1, 7)[:, :2].copy()
    force[:, :3] = FORCE
    physics.control.joint_f.assign(force.reshape(-1))
    targets = physics.control.joint_target_q.numpy().reshape(3, -1)
    targets[:, 3] = TILT
    physics.control.joint_target_q.assign(targets.reshape(-1))
    for _ in range(STEPS):
        physics.tick(lambda current: None)
    return physics, poses, physics.state.joint_q.numpy().reshape(3, -1)[:, : build.GRIPPER_DOFS].copy()


def test_fingers_and_cups_turn_about_the_vertical_where_they_are(turned):
    _, poses, _ = turned
    for yaw, pair in zip(YAW, poses, strict=True):
        for pose in pair:
            np.testing.assert_allclose(pose[:3], PLACE, atol=1e-5)
            expected = [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
            np.testing.assert_allclose(rotation_of(pose[3:]), expected, atol=1e-5)


def test_turned_grippers_are_pushed_along_the_worlds_axes(turned):
    physics, _, last = turned
    gripper, time = settings().gripper, STEPS * physics.settings.step
    way = FORCE * time**2 / (2 * (gripper.finger_mass + gripper.cup_mass))
    # The cup's mass, which swings as the cup tilts, pulls at the finger a little.
    np.testing.assert_allclose(last[:, :3] - PLACE, np.tile(way, (3, 1)), atol=0.5 * gripper.cup_mass * gripper.cup_length)


def test_cups_tilt_to_their_targets_and_point_where_yaw_and_tilt_say(turned):
    physics, _, last = turned
    np.testing.assert_allclose(last[:, 3], TILT, atol=5e-3)
    poses = physics.state.body_q.numpy().reshape(3, -1, 7)
    for yaw, tilt, pose in zip(YAW, last[:, 3], poses[:, 1], strict=True):
        axis = [np.sin(tilt) * np.cos(yaw), np.sin(tilt) * np.sin(yaw), np.cos(tilt)]
        np.testing.assert_allclose(rotation_of(pose[3:])[:, 2], axis, atol=1e-4)
