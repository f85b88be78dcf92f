"""The gripper's task: goals, impedance force."""

from __future__ import annotations

import newton
import warp as wp

from synpick_warp.kernels import impedance
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.physics import Physics
from synpick_warp.stages.worlds import WorldState


def begin_moving(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Count frames; where a world begins to act, draw the corners' order and put the gripper above the first."""
    wp.launch(
        impedance.begin_moving_kernel,
        dim=state.phase.shape[0],
        inputs=[wp.uint64(seed), scene.layout, scene.move, state.address, state.phase, state.frame, physics.state.joint_q,
                physics.state.joint_qd],
        outputs=[state.order, state.goal, state.waypoint],
        device=state.phase.device,
    )


def drive_gripper(scene: SceneData, state: WorldState, physics: Physics, current: newton.State) -> None:
    """Move the goals on by one step and set the grippers' forces."""
    wp.launch(
        impedance.drive_gripper_kernel,
        dim=state.phase.shape[0],
        inputs=[scene.layout, scene.move, state.phase, state.order, current.joint_q, current.joint_qd, state.goal, state.waypoint],
        outputs=[physics.control.joint_f],
        device=state.phase.device,
    )
