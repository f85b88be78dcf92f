"""Gripper control and attempts: setpoints, impedance control, task transitions. Launches kernels.sim.gripper and tasks."""

from typing import Protocol

import newton
import warp as wp

from synpick_warp.kernels.sim import gripper, tasks
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.images import Observation, Plan
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState


class SetpointLaw(Protocol):
    """Path of a gripper's setpoint through the tasks of an attempt, and when each is complete; all `Task`s come in their order."""

    def begin(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics) -> None:
        """Place gripper and setpoint where task APPROACH begins. Runs after perception."""

    def advance(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """Advance the setpoints by a step of physics, in mode MOVE, too, up to task PRESS. Runs before the step."""

    def end_tick(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """Begin task LIFT, and after it judge the attempt and begin LOOK. Runs at the end of a tick, after the hold has engaged."""


class TwoSpeedLaw:
    """Setpoint law of the paper: fast to a point before the grasp, slowly along its normal, a rest, and up."""

    def begin(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics) -> None:
        """Place the gripper `appear_height` above the grasp."""
        sources = (scene, state, attempts, plan, physics.state)
        launch(tasks.place_grippers_kernel, len(state.phase), *sources, physics.control)

    def advance(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """Advance the setpoints by a step."""
        launch(gripper.advance_setpoints_kernel, len(state.phase), scene, state, attempts, plan)

    def end_tick(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """Complete tasks PRESS, by time, and LIFT, by the setpoint's arrival."""
        launch(tasks.advance_tasks_kernel, len(state.phase), scene, state, attempts, plan)


TWO_SPEEDS: SetpointLaw = TwoSpeedLaw()
"""Setpoint law of the grippers that ship."""


def begin_moving(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Count frames; in the first frame of mode MOVE, sample the order of corners and place the gripper above the first."""
    launch(gripper.begin_moving_kernel, len(state.phase), scene, state, physics.state, seed=wp.uint64(seed))


def begin_picking(
    scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, physics: Physics
) -> None:
    """Reset the attempt state where picking begins, with task LOOK, and clear the outcomes of the last tick."""
    sources = (scene, state, attempts, observation, plan)
    launch(tasks.begin_picking_kernel, len(state.phase), *sources, physics.control)


def clear_seals(state: WorldState, seals: SealState) -> None:
    """Detach all objects in worlds outside of phase ACT."""
    launch(tasks.clear_seals_kernel, seals.attached.shape, state, seals)


def set_shaft_collision(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """Enable collisions of the gripper shaft in mode MOVE, disable them in picking modes."""
    launch(tasks.set_shaft_collision_kernel, len(state.phase), scene, state, shape_transform=physics.model.shape_transform)


def drive_gripper(
    scene: SceneData,
    state: WorldState,
    attempts: AttemptState,
    plan: Plan,
    physics: Physics,
    current: newton.State,
    law: SetpointLaw = TWO_SPEEDS,
) -> None:
    """Advance the setpoints by one step and write the grippers' joint forces."""
    law.advance(scene, state, attempts, plan)
    launch(gripper.drive_gripper_kernel, len(state.phase), scene, state, attempts, current, physics.control)


def remove_lost(scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, physics: Physics) -> None:
    """Remove objects that have left the tote from the scene, and break their seals."""
    launch(tasks.remove_lost_kernel, state.catalog_index.shape, scene, state, attempts, seals, physics.state)


def advance_tasks(
    scene: SceneData,
    state: WorldState,
    attempts: AttemptState,
    seals: SealState,
    plan: Plan,
    physics: Physics,
    law: SetpointLaw = TWO_SPEEDS,
) -> None:
    """Task transitions at the end of a tick: judge complete lifts, remove picked objects, send grippers home."""
    sources = (scene, state, attempts, seals)
    launch(tasks.pack_attached_kernel, attempts.attached_words.shape, *sources)
    law.end_tick(scene, state, attempts, plan)
    if scene.tries_another:
        launch(tasks.count_target_failures_kernel, attempts.target_failures.shape, state, attempts, plan)
    launch(tasks.end_attempts_kernel, len(state.phase), *sources, physics.state, physics.control)


def park_removed(scene: SceneData, state: WorldState, attempts: AttemptState, physics: Physics) -> None:
    """Move the bodies of removed objects to their parking places, at rest."""
    launch(tasks.park_removed_kernel, state.catalog_index.shape, scene, state, attempts, physics.state, physics.control)


def begin_attempts(
    scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics, law: SetpointLaw = TWO_SPEEDS
) -> None:
    """Begin the planned attempts: place the gripper where the approach begins, with the planned yaw and tilt."""
    launch(tasks.begin_attempts_kernel, len(state.phase), state, attempts, plan)
    place_grippers(scene, state, attempts, plan, physics, law)


def place_grippers(
    scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics, law: SetpointLaw = TWO_SPEEDS
) -> None:
    """Place the gripper where task APPROACH begins, with the planned yaw and tilt."""
    law.begin(scene, state, attempts, plan, physics)
    physics.set_yaw(plan.yaw)
