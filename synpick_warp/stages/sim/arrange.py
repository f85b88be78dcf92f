"""Episode life cycle: assign, sample, drop, settle, end. Launches kernels.sim.arrangement, rest and endings."""

from __future__ import annotations

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import Config
from synpick_warp.kernels import structs
from synpick_warp.kernels.sim import arrangement, endings, rest
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.constants import SceneData, drop_data, mode_data, mode_rows
from synpick_warp.stages.perception.arrays import Observation
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.worlds import AttemptState, WorldState


def assign_episodes(state: WorldState, episodes: wp.array, tries: int) -> None:
    """Assign the next of `episodes` (episode) int32 to free worlds, or the same again if it ended without delivery, up to `tries` times."""
    wp.launch(
        arrangement.assign_episodes_kernel,
        dim=1,
        inputs=[state.phase.shape[0], episodes, tries, state.arrangement_id, state.phase, state.ending, state.next_episode],
        device=state.phase.device,
    )


def sample_episodes(scene: SceneData, state: WorldState, seed: int) -> None:
    """Sample mode, objects and light of starting episodes."""
    worlds, device = state.phase.shape[0], state.phase.device
    wp.launch(
        arrangement.sample_modes_kernel,
        dim=worlds,
        inputs=[wp.uint64(seed), scene.modes, state.arrangement_id, state.phase],
        outputs=[state.mode],
        device=device,
    )
    wp.launch(
        arrangement.sample_objects_kernel,
        dim=worlds,
        inputs=[wp.uint64(seed), scene.layout, scene.catalog, scene.drop, state.arrangement_id, state.mode, state.phase, state.ending],
        outputs=[state.catalog_index, state.body_slot],
        device=device,
    )
    wp.launch(
        arrangement.sample_lights_kernel,
        dim=worlds,
        inputs=[wp.uint64(seed), scene.drop, state.arrangement_id, state.phase],
        outputs=[state.light, state.light_yaw, state.light_exposure],
        device=device,
    )


def sample_episodes_ahead(config: Config, catalog: Catalog, episodes: np.ndarray, device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Sample modes and objects of episodes ahead of their start. Waits for the device.

    Args:
        config: All settings.
        catalog: The objects.
        episodes: Indices (episode) int32.
        device: Device that samples.

    Returns:
        `Mode` (episode) int32, and number of objects in the first arrangement (episode) int64. A world's slots may suffice for fewer.
    """
    count, seed = len(episodes), wp.uint64(config.bake.seed)
    identity = wp.array(np.stack([episodes, np.zeros_like(episodes)], axis=1), dtype=wp.vec2i, device=device)
    mode, ending = (wp.zeros(count, dtype=wp.int32, device=device) for _ in range(2))
    phase = wp.full(count, int(Phase.START), dtype=wp.int32, device=device)
    wp.launch(
        arrangement.sample_modes_kernel,
        dim=count,
        inputs=[seed, mode_data(mode_rows(config.bake, config.splits), device), identity, phase],
        outputs=[mode],
        device=device,
    )
    layout, objects = structs.LayoutData(), structs.CatalogData()
    layout.instances = layout.single_slots = config.arrangement.max_objects
    layout.slots = 2 * layout.instances
    objects.count = len(catalog)
    objects.volume = wp.array([entry.volume for entry in catalog.entries], dtype=float, device=device)
    objects.compound = wp.zeros(len(catalog), dtype=int, device=device)
    drop = drop_data(config.arrangement, config.render, config.tote, config.pick, config.move, config.physics.gravity, 1)
    index, slot = (wp.empty((count, layout.instances), dtype=wp.int32, device=device) for _ in range(2))
    wp.launch(
        arrangement.sample_objects_kernel,
        dim=count,
        inputs=[seed, layout, objects, drop, identity, mode, phase, ending],
        outputs=[index, slot],
        device=device,
    )
    return mode.numpy(), np.count_nonzero(index.numpy() >= 0, axis=1)


def drop_objects(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Reset free worlds, stack sampled objects above the tote, and load variants and joint coordinates into the physics."""
    worlds, device = state.phase.shape[0], state.phase.device
    joints = [physics.state.joint_q, physics.state.joint_qd, physics.control.joint_f]
    wp.launch(
        arrangement.reset_worlds_kernel,
        dim=worlds,
        inputs=[scene.layout, scene.catalog, scene.drop, state.phase],
        outputs=[state.variant, *joints, state.restarted, state.progress, state.stuck],
        device=device,
    )
    wp.launch(
        arrangement.drop_objects_kernel,
        dim=worlds,
        inputs=[
            wp.uint64(seed),
            scene.layout,
            scene.catalog,
            scene.drop,
            state.arrangement_id,
            state.catalog_index,
            state.body_slot,
            state.phase,
        ],
        outputs=[state.variant, *joints],
        device=device,
    )
    physics.load(state.variant, state.restarted)


def measure_penetration(state: WorldState, physics: Physics) -> None:
    """Measure the deepest penetration of each body from the contacts of the last step."""
    contacts = physics.contacts
    state.penetration.zero_()
    wp.launch(
        rest.measure_penetration_kernel,
        dim=contacts.rigid_contact_max,
        inputs=[
            contacts.rigid_contact_count,
            contacts.rigid_contact_shape0,
            contacts.rigid_contact_shape1,
            contacts.rigid_contact_point0,
            contacts.rigid_contact_point1,
            contacts.rigid_contact_normal,
            contacts.rigid_contact_margin0,
            contacts.rigid_contact_margin1,
            physics.model.shape_body,
            physics.state.body_q,
        ],
        outputs=[state.penetration],
        device=state.phase.device,
    )


def measure_displacement(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """Measure the displacement of each instance over the last tick."""
    wp.launch(
        rest.measure_displacement_kernel,
        dim=state.catalog_index.shape,
        inputs=[scene.layout, scene.catalog, state.catalog_index, state.body_slot, physics.state.body_q, state.previous_pose],
        outputs=[state.displacement],
        device=state.phase.device,
    )


def judge_settling(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Re-drop objects that left the tote or are stuck, count ticks at rest, and begin phase ACT in worlds at rest."""
    measure_penetration(state, physics)
    measure_displacement(scene, state, physics)
    wp.launch(
        rest.redrop_objects_kernel,
        dim=state.phase.shape[0],
        inputs=[
            wp.uint64(seed),
            scene.layout,
            scene.catalog,
            scene.drop,
            scene.settle,
            state.arrangement_id,
            state.phase,
            state.catalog_index,
            state.body_slot,
            physics.state.body_q,
            state.penetration,
            state.stuck,
            state.progress,
            physics.state.joint_q,
            physics.state.joint_qd,
        ],
        device=state.phase.device,
    )
    wp.launch(
        rest.judge_rest_kernel,
        dim=state.phase.shape[0],
        inputs=[scene.layout, scene.settle, state.catalog_index, state.displacement, state.phase, state.progress],
        device=state.phase.device,
    )


def judge_episodes(scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, physics: Physics) -> None:
    """End episodes that failed or are complete."""
    worlds, device = state.phase.shape[0], state.phase.device
    wp.launch(
        endings.judge_tasks_kernel,
        dim=worlds,
        inputs=[
            scene.layout,
            scene.move,
            scene.pick,
            state.phase,
            state.mode,
            state.catalog_index,
            state.waypoint,
            attempts.task,
            attempts.failures,
        ],
        outputs=[state.ending],
        device=device,
    )
    wp.launch(
        endings.judge_episodes_kernel,
        dim=worlds,
        inputs=[
            scene.layout,
            scene.settle,
            state.catalog_index,
            state.body_slot,
            physics.state.body_q,
            physics.solver.constraint_overflow,
            observation.overflow,
            state.progress,
            state.phase,
            state.ending,
        ],
        device=device,
    )


def set_guides(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """Enable guide walls while a world's objects fall, disable them afterwards."""
    wp.launch(
        rest.set_guides_kernel,
        dim=(state.phase.shape[0], scene.guide_shapes.shape[0]),
        inputs=[scene.layout, scene.guide_shapes, state.progress],
        outputs=[physics.model.shape_transform],
        device=state.phase.device,
    )
