"""New episodes into free worlds: numbers, objects, drop poses; then settling until the pile is at rest."""

from __future__ import annotations

import newton
import warp as wp

from synpick_warp.kernels import arrangement, rest
from synpick_warp.stages.physics import Physics
from synpick_warp.stages.worlds import SceneData, WorldState


def take_episodes(state: WorldState, episodes: int, attempts: int) -> None:
    """Give worlds whose episode is over the next episode number, or their own again if it delivered nothing."""
    wp.launch(
        arrangement.take_episodes_kernel,
        dim=1,
        inputs=[state.phase.shape[0], episodes, attempts, state.address, state.phase, state.outcome, state.next_episode],
        device=state.phase.device,
    )


def draw_objects(scene: SceneData, state: WorldState, seed: int) -> None:
    """Draw the objects of worlds that start an episode."""
    wp.launch(
        arrangement.draw_objects_kernel,
        dim=state.phase.shape[0],
        inputs=[wp.uint64(seed), scene.layout, scene.catalog, scene.drop, state.address, state.phase, state.outcome],
        outputs=[state.entry, state.slot, state.light, state.light_turn],
        device=state.phase.device,
    )


def drop_objects(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Stack the drawn objects above the tote and load them into the physics."""
    wp.launch(
        arrangement.drop_objects_kernel,
        dim=state.phase.shape[0],
        inputs=[wp.uint64(seed), scene.layout, scene.catalog, scene.drop, state.address, state.entry, state.slot, state.phase,
                state.progress, state.stuck],
        outputs=[state.variant, physics.state.joint_q, physics.state.joint_qd, physics.control.joint_f, state.restarted],
        device=state.phase.device,
    )
    physics.load(state.variant, state.restarted)


def measure_depth(state: WorldState, physics: Physics) -> None:
    """Deepest penetration of each body, from the contacts of the last step."""
    contacts = physics.contacts
    state.depth.zero_()
    wp.launch(
        rest.measure_depth_kernel,
        dim=contacts.rigid_contact_max,
        inputs=[contacts.rigid_contact_count, contacts.rigid_contact_shape0, contacts.rigid_contact_shape1, contacts.rigid_contact_point0,
                contacts.rigid_contact_point1, contacts.rigid_contact_normal, contacts.rigid_contact_margin0,
                contacts.rigid_contact_margin1, physics.model.shape_body, physics.state.body_q],
        outputs=[state.depth],
        device=state.phase.device,
    )


def measure_shift(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """How far each instance moved in the last tick."""
    wp.launch(
        rest.measure_shift_kernel,
        dim=state.entry.shape,
        inputs=[scene.layout, scene.catalog, state.entry, state.slot, physics.state.body_q, state.previous],
        outputs=[state.shift],
        device=state.phase.device,
    )


def judge_settling(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Count ticks at rest, re-drop what left the tote or is stuck, let worlds at rest act."""
    measure_depth(state, physics)
    measure_shift(scene, state, physics)
    wp.launch(
        rest.judge_settling_kernel,
        dim=state.phase.shape[0],
        inputs=[wp.uint64(seed), scene.layout, scene.catalog, scene.drop, scene.settle, state.address, state.entry, state.slot,
                physics.state.body_q, state.shift, state.depth, state.stuck, state.progress, state.phase,
                physics.state.joint_q, physics.state.joint_qd],
        device=state.phase.device,
    )


def judge_episodes(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """End episodes that failed or are finished."""
    wp.launch(
        rest.judge_episodes_kernel,
        dim=state.phase.shape[0],
        inputs=[scene.layout, scene.settle, scene.move.waypoints, state.entry, state.slot, physics.state.body_q,
                physics.solver.constraint_overflow, state.progress, state.waypoint, state.phase, state.outcome],
        device=state.phase.device,
    )


def set_guides(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """Guide walls stand while a world's objects fall."""
    wp.launch(
        rest.set_guides_kernel,
        dim=(state.phase.shape[0], scene.guide_shapes.shape[0]),
        inputs=[scene.layout, scene.guide_shapes, int(newton.ShapeFlags.COLLIDE_SHAPES), state.progress, physics.model.shape_flags],
        device=state.phase.device,
    )
