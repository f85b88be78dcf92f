"""Gripper control and attempts: setpoints, impedance control, task transitions. Launches kernels.sim.gripper and tasks."""

from __future__ import annotations

import newton
import warp as wp

from synpick_warp.kernels.sim import gripper, tasks
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.perception.arrays import Observation, Plan
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState


def begin_moving(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Count frames; in the first frame of mode MOVE, sample the order of corners and place the gripper above the first."""
    wp.launch(
        gripper.begin_moving_kernel,
        dim=state.phase.shape[0],
        inputs=[
            wp.uint64(seed),
            scene.layout,
            scene.move,
            state.arrangement_id,
            state.mode,
            state.phase,
            state.frame,
            physics.state.joint_q,
            physics.state.joint_qd,
        ],
        outputs=[state.corner_order, state.setpoint, state.waypoint],
        device=state.phase.device,
    )


def begin_picking(
    scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, physics: Physics
) -> None:
    """Reset the attempt state where picking begins, with task LOOK, and clear the outcomes of the last tick."""
    wp.launch(
        tasks.begin_picking_kernel,
        dim=state.phase.shape[0],
        inputs=[scene.layout, state.phase, state.mode, state.frame],
        outputs=[
            attempts.task,
            attempts.steps,
            attempts.attempt,
            attempts.outcome,
            attempts.failures,
            plan.target,
            plan.yaw,
            observation.overflow,
            attempts.removed,
            physics.control.joint_target_q,
        ],
        device=state.phase.device,
    )


def clear_seals(state: WorldState, seals: SealState) -> None:
    """Detach all objects in worlds outside of phase ACT."""
    wp.launch(tasks.clear_seals_kernel, dim=seals.attached.shape, inputs=[state.phase], outputs=[seals.attached], device=state.phase.device)


def set_shaft_collision(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """Enable collisions of the gripper shaft in mode MOVE, disable them in picking modes."""
    wp.launch(
        tasks.set_shaft_collision_kernel,
        dim=state.phase.shape[0],
        inputs=[scene.layout, state.mode],
        outputs=[physics.model.shape_transform],
        device=state.phase.device,
    )


def drive_gripper(scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics, current: newton.State) -> None:
    """Advance the setpoints by one step and write the grippers' joint forces."""
    worlds, device = state.phase.shape[0], state.phase.device
    wp.launch(
        gripper.advance_setpoints_kernel,
        dim=worlds,
        inputs=[
            scene.move,
            scene.pick,
            state.phase,
            state.mode,
            state.corner_order,
            plan.point,
            plan.normal,
            attempts.task,
            attempts.steps,
            state.waypoint,
            state.setpoint,
        ],
        device=device,
    )
    wp.launch(
        gripper.drive_gripper_kernel,
        dim=worlds,
        inputs=[
            scene.layout,
            scene.move,
            scene.pick,
            state.phase,
            state.mode,
            attempts.task,
            state.setpoint,
            current.joint_q,
            current.joint_qd,
        ],
        outputs=[physics.control.joint_f],
        device=device,
    )


def remove_lost(scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, physics: Physics) -> None:
    """Remove objects that have left the tote from the scene, and break their seals."""
    wp.launch(
        tasks.remove_lost_kernel,
        dim=state.catalog_index.shape,
        inputs=[
            scene.layout,
            scene.drop,
            scene.settle,
            scene.pick,
            state.phase,
            state.body_slot,
            state.displacement,
            physics.state.body_q,
            state.catalog_index,
        ],
        outputs=[attempts.removed, seals.attached],
        device=state.phase.device,
    )


def advance_tasks(scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, plan: Plan, physics: Physics) -> None:
    """Task transitions at the end of a tick: judge complete lifts, remove picked objects, send grippers home."""
    worlds, device = state.phase.shape[0], state.phase.device
    wp.launch(
        tasks.pack_attached_kernel,
        dim=worlds,
        inputs=[scene.layout, state.catalog_index, seals.attached],
        outputs=[attempts.attached_bits],
        device=device,
    )
    wp.launch(
        tasks.advance_tasks_kernel,
        dim=worlds,
        inputs=[
            scene.move,
            scene.pick,
            state.phase,
            state.mode,
            state.setpoint,
            plan.point,
            plan.normal,
            plan.target,
            attempts.engaged_bits,
            attempts.attached_bits,
            attempts.task,
            attempts.steps,
            attempts.failures,
        ],
        outputs=[attempts.outcome],
        device=device,
    )
    wp.launch(
        tasks.end_attempts_kernel,
        dim=worlds,
        inputs=[scene.layout, scene.drop, state.phase, attempts.task, attempts.attached_bits],
        outputs=[
            state.catalog_index,
            attempts.removed,
            seals.attached,
            physics.state.joint_q,
            physics.state.joint_qd,
            physics.control.joint_target_q,
        ],
        device=device,
    )


def park_removed(scene: SceneData, state: WorldState, attempts: AttemptState, physics: Physics) -> None:
    """Move the bodies of removed objects to their parking places, at rest."""
    wp.launch(
        tasks.park_removed_kernel,
        dim=state.catalog_index.shape,
        inputs=[scene.layout, state.body_slot, attempts.removed],
        outputs=[physics.state.joint_q, physics.state.joint_qd, physics.control.joint_f],
        device=state.phase.device,
    )


def begin_attempts(scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics) -> None:
    """Begin the planned attempts: place the gripper above the grasp, with the planned yaw and tilt."""
    worlds, device = state.phase.shape[0], state.phase.device
    wp.launch(
        tasks.begin_attempts_kernel,
        dim=worlds,
        inputs=[state.phase, plan.target, attempts.task, attempts.attempt],
        outputs=[attempts.steps, attempts.hits, attempts.engaged_bits],
        device=device,
    )
    wp.launch(
        tasks.place_grippers_kernel,
        dim=worlds,
        inputs=[scene.layout, scene.move, scene.pick, state.phase, attempts.task, attempts.steps, plan.point, plan.normal, plan.tilt],
        outputs=[state.setpoint, physics.state.joint_q, physics.state.joint_qd, physics.control.joint_target_q],
        device=device,
    )
    physics.set_yaw(plan.yaw)
