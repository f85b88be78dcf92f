"""Episode life cycle: assign, sample, drop, settle, end. Launches kernels.sim.arrangement, drop, rest and endings."""

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import Config
from synpick_warp.kernels import structs
from synpick_warp.kernels.sim import arrangement, drop, endings, rest
from synpick_warp.kernels.state import Worlds
from synpick_warp.scenes.build import without_distractors
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.constants import SceneData, count_columns, drop_data, mode_data, mode_rows
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.images import Observation
from synpick_warp.stages.sim.physics import Physics, contact_arrays
from synpick_warp.stages.sim.worlds import AttemptState, WorldState


def assign_episodes(state: WorldState, episodes: wp.array, tries: int) -> None:
    """Assign the next of `episodes` (episode) int32 to free worlds, or the same again if it ended without delivery, up to `tries` times."""
    launch(arrangement.assign_episodes_kernel, 1, state, worlds=len(state.phase), episodes=episodes, tries=tries)


def free_idle_worlds(state: WorldState) -> None:
    """Free the worlds that are idle, so that `assign_episodes` assigns episodes to them."""
    launch(arrangement.free_idle_worlds_kernel, len(state.phase), state)


def sample_episodes(scene: SceneData, state: WorldState, seed: int) -> None:
    """Sample mode, bin, objects, distractors and light of starting episodes."""
    kernels = (arrangement.sample_modes_kernel, arrangement.sample_bins_kernel, arrangement.sample_objects_kernel)
    if scene.catalog.distractors:
        kernels += (arrangement.sample_distractors_kernel,)
    for kernel in (*kernels, arrangement.sample_lights_kernel):
        launch(kernel, len(state.phase), scene, state, seed=wp.uint64(seed))


def sample_episodes_ahead(config: Config, catalog: Catalog, episodes: np.ndarray, device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Sample modes and objects of episodes (episode) int32 ahead of their start, on a device, for which it waits. Returns `Mode` (episode)
    int32, and number of objects in the first arrangement (episode) int64. A world's slots may suffice for fewer."""
    count, seed = len(episodes), wp.uint64(config.bake.seed)
    state, room = Worlds(), config.arrangement.max_objects
    state.arrangement_id = wp.array(np.stack([episodes, np.zeros_like(episodes)], axis=1), dtype=wp.vec2i, device=device)
    state.mode, state.ending = (wp.zeros(count, dtype=wp.int32, device=device) for _ in range(2))
    state.phase = wp.full(count, int(Phase.START), dtype=wp.int32, device=device)
    state.catalog_index, state.body_slot = (wp.empty((count, room), dtype=wp.int32, device=device) for _ in range(2))
    modes = mode_data(mode_rows(config.bake, config.splits), device)
    wp.launch(arrangement.sample_modes_kernel, dim=count, inputs=[seed, modes, state], device=device)
    layout, objects = structs.LayoutData(), structs.CatalogData()
    layout.instances = layout.single_slots = room
    layout.slots = 2 * layout.instances
    objects.count = len(catalog)
    objects.volume = wp.array([entry.volume for entry in catalog.entries], dtype=float, device=device)
    objects.compound = wp.zeros(len(catalog), dtype=int, device=device)
    for name, value in count_columns(config.arrangement.counts, catalog, device).items():
        setattr(objects, name, value)
    labelled = without_distractors(config.arrangement, config.randomize.most_distractors)
    rules = drop_data(labelled, config.render, config.pick, config.move, config.physics.gravity, 1)
    wp.launch(arrangement.sample_objects_kernel, dim=count, inputs=[seed, layout, objects, rules, state], device=device)
    return state.mode.numpy(), np.count_nonzero(state.catalog_index.numpy() >= 0, axis=1)


def drop_objects(scene: SceneData, state: WorldState, physics: Physics, seed: int) -> None:
    """Reset free worlds, stack or scatter sampled objects above the bin, and load variants and joint coordinates into the physics."""
    sources = (scene, state, physics.state, physics.control)
    launch(drop.reset_worlds_kernel, len(state.phase), *sources)
    launch(drop.drop_objects_kernel, len(state.phase), *sources, seed=wp.uint64(seed))
    if scene.upright > 0.0:
        launch(drop.raise_objects_kernel, state.catalog_index.shape, *sources, seed=wp.uint64(seed))
    if scene.scattered:
        launch(drop.scatter_objects_kernel, len(state.phase), *sources, seed=wp.uint64(seed))
    physics.load(state.variant, state.restarted)


def measure_penetration(state: WorldState, physics: Physics) -> None:
    """Measure the deepest penetration of each body from the contacts of the last step."""
    state.penetration.zero_()
    threads, contacts = physics.contacts.rigid_contact_max, contact_arrays(physics)
    launch(rest.measure_penetration_kernel, threads, state, physics.state, contacts=contacts)


def measure_displacement(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """Measure the displacement of each instance over the last tick."""
    launch(rest.measure_displacement_kernel, state.catalog_index.shape, scene, state, physics.state)


def judge_settling(scene: SceneData, state: WorldState, physics: Physics, seed: int, restless: float) -> None:
    """Re-drop objects that left or are stuck, count ticks at rest, begin phase ACT in worlds at rest; `restless`: of `settle`."""
    measure_penetration(state, physics)
    measure_displacement(scene, state, physics)
    launch(rest.redrop_objects_kernel, len(state.phase), scene, state, physics.state, seed=wp.uint64(seed))
    launch(rest.judge_rest_kernel, len(state.phase), scene, state, restless=restless)


def judge_episodes(scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, physics: Physics) -> None:
    """End episodes that failed or are complete."""
    launch(endings.judge_tasks_kernel, len(state.phase), scene, state, attempts)
    overflows = {"solver_overflow": physics.solver.constraint_overflow, "perception_overflow": observation.overflow}
    launch(endings.judge_episodes_kernel, len(state.phase), scene, state, physics.state, lost=physics.lost, **overflows)


def place_bins(scene: SceneData, state: WorldState, physics: Physics) -> None:
    """Place the collision shapes of each world's bin, and its guide walls while objects fall."""
    dim = (len(state.phase), scene.bins.shape.shape[0])
    launch(rest.place_bins_kernel, dim, scene, state, shape_transform=physics.model.shape_transform)
