"""Simulation of all worlds, tick by tick: one tick is one output frame of simulated time. Nothing here waits for the device."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.dataset import DataLayout, may_pick
from synpick_warp.configs.schema import Config
from synpick_warp.errors import StateError
from synpick_warp.kernels.sim import snapshot as pack
from synpick_warp.newton_patches import KNOWN_NEWTON
from synpick_warp.scenes.build import build_model
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LastFrame, Snapshot
from synpick_warp.stages.constants import SceneData, make_scene_data
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.images import Observation, Plan
from synpick_warp.stages.perception.perceive import Perception
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim import arrange, gripper
from synpick_warp.stages.sim.behavior import Hold, behavior_of
from synpick_warp.stages.sim.physics import ENDED, Physics
from synpick_warp.stages.sim.sleep import Sleep
from synpick_warp.stages.sim.states import State, WorldStates, cell_checksum, checksum, copy_fresh
from synpick_warp.stages.sim.step_log import PhysicsRecord, StepRecorder
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState, WorldStatus, world_sizes
from synpick_warp.stages.timing import scope


@dataclass(frozen=True, eq=False)
class TickRecord:
    """Results of the last tick on the device: snapshot, status, perception, recorded physics (None: not recorded); the next tick overwrites
    the arrays.

    `observation` and `plan` are the arrays with which the simulation itself works, not copies.
    """

    snapshot: Snapshot
    status: WorldStatus
    observation: Observation
    plan: Plan
    physics: PhysicsRecord | None = None


def allocate_worlds(sizes: dict[str, int], device: wp.Device) -> tuple[WorldState, AttemptState, SealState, LastFrame, TickRecord]:
    """Allocate the state of all worlds and the record of a tick, without physics (see `StepRecorder`); `sizes`: of `world_sizes`."""
    record = TickRecord(*(allocate(kind, sizes, device) for kind in (Snapshot, WorldStatus, Observation, Plan)))
    state, attempts, seals = allocate(WorldState, sizes, device), allocate(AttemptState, sizes, device), allocate(SealState, sizes, device)
    return state, attempts, seals, allocate(LastFrame, sizes, device), record


class Simulation:
    """Batched simulation: each world runs one episode after another, until none is left in the list."""

    def __init__(
        self,
        config: Config,
        catalog: Catalog,
        lights: int,
        device: wp.Device,
        render_scene: RenderScene | None = None,
        episodes: Sequence[int] | None = None,
        records_physics: bool = False,
    ) -> None:
        """Build the model and allocate all state.

        `lights` is the count of environment maps to sample from, `render_scene` what perception renders, not needed if all episodes have
        mode MOVE, and `episodes` the indices to simulate, in order; None: all. `records_physics`: whether records contain `physics`, with
        steps if `trajectory.steps`; with `bop.graph` they contain support. Raises ValueError if an episode may pick, but there is no
        `render_scene`."""
        self.config, self.catalog, self.device = config, catalog, device
        built = build_model(config, catalog, device)
        self.layout = built.layout
        self.physics = Physics(config.physics, built)
        self.scene: SceneData = make_scene_data(config, catalog, built, lights, device)
        planned = [index for each in DataLayout.of(config).plan() for index in each] if episodes is None else episodes
        indices = np.asarray(planned, np.int32)
        self.episodes = self._former = wp.array(indices, dtype=wp.int32, device=device)
        sizes = world_sizes(
            config.bake.worlds, config.arrangement.max_objects, config.move.rounds, built.layout.bodies_per_world, len(built.head.cups)
        )
        self.state, self.attempts, self.seals, self.last, record = allocate_worlds(sizes, device)
        self.state.bin_pose.fill_(wp.transform_identity())
        self.scene.bins.chosen, self.scene.bins.pose = self.state.bin, self.state.bin_pose
        self.observation, self.plan = record.observation, record.plan
        self.recorder: StepRecorder | None = None
        if records_physics or config.bop.graph:
            parts = {"steps": records_physics and config.trajectory.steps, "supports": config.bop.graph}
            states = (self.state, self.attempts, self.seals)
            self.recorder = StepRecorder(config.gripper, self.scene, *states, self.physics, sizes, **parts)
        self.record = replace(record, physics=self.recorder and self.recorder.record)
        self.sleep = Sleep(self.scene, self.physics) if config.physics.sleep > 0.0 else None
        self._fresh = copy_fresh(self._groups, self.physics)
        self.behavior = behavior_of(config.gripper.kind)
        self.after_tick: Callable[[], None] | None = None
        """Launches kernels at the end of a tick, after perception."""
        self._is_between_ticks = False
        """Whether a tick is complete and none has begun."""
        self.hold: Hold | None = None
        self.perception: Perception | None = None
        if may_pick(config.bake, config.splits):
            if render_scene is None:
                raise ValueError("episodes that pick need a render_scene for perception")
            self.hold = self.behavior.hold(config.suction, catalog, render_scene, device)
            state = (self.scene, self.state, self.attempts, self.observation, self.plan)
            self.perception = Perception(config.perception, config.rig, config.bake.seed, render_scene, *state, self.behavior.choose_grasps)

    def tick(self, perceives: bool = True) -> None:
        """Advance all worlds by one tick; `record` has its output. `perceives`: False: worlds whose task is LOOK wait."""
        for _ in self.tick_parts(perceives):
            pass

    def tick_parts(self, perceives: bool = True) -> Iterator[None]:
        """Advance all worlds by one tick: a generator that yields after episodes are started and after each substep of physics.

        The caller can enqueue other work on other streams between.

        Start episodes, step physics, update tasks, end episodes, copy the snapshot, then plan attempts in worlds whose task is LOOK.
        """
        resets, self._is_between_ticks = self._is_between_ticks and newton.__version__ == KNOWN_NEWTON, False
        with scope("arrange", self.device):
            self._arrange(resets)
        yield
        substeps = self.physics.tick_parts(self._drive, self._ignore_contacts, self._watcher)
        while True:
            with scope("physics", self.device):
                if next(substeps, ENDED) is ENDED:
                    break
            yield
        with scope("judge", self.device):
            self._judge()
        with scope("snapshot", self.device):
            self._take_snapshot()
            if self.recorder is not None:
                self.recorder.end_tick()
        if self.perception is not None and perceives:
            with scope("perceive", self.device):
                self.perception.perceive(self.record.snapshot)
                gripper.begin_attempts(self.scene, self.state, self.attempts, self.plan, self.physics, self.behavior.law)
        if self.after_tick is not None:
            with scope("save states", self.device):
                self.after_tick()
        self._is_between_ticks = True

    @property
    def _watcher(self) -> StepRecorder | None:
        """Recorder, if it must see the steps of a tick."""
        return self.recorder if self.recorder is not None and self.recorder.watches else None

    @property
    def states(self) -> WorldStates:
        """Checkpoints of the worlds (`WorldStates`), to be used between two ticks and on the stream of the ticks. Raises StateError if the
        worlds have not ticked yet, or are in a tick."""
        if not self._is_between_ticks:
            raise StateError("the state of a world is complete between two ticks alone, after the first one")
        return self._states

    @cached_property
    def _states(self) -> WorldStates:
        if self.recorder is None:
            return self.checkpoints
        return self._make_states(drops=self.recorder.record.drops)

    @cached_property
    def checkpoints(self) -> WorldStates:
        """Checkpoints without what a record of physics keeps, so that simulations without one can load them; after the first tick."""
        return self._make_states()

    @property
    def _groups(self) -> dict[str, object]:
        """Groups of arrays that are state, by their names."""
        groups: dict[str, object] = {"worlds": self.state, "attempts": self.attempts, "seals": self.seals, "last": self.last}
        groups |= {name: getattr(self.record, name) for name in ("snapshot", "status", "observation", "plan")}
        return groups if self.sleep is None else groups | {"sleep": self.sleep.state}

    def _make_states(self, **recorded: object) -> WorldStates:
        """Checkpoints of the groups of arrays of this simulation, and of others by name."""
        origin = {"catalog": checksum(self.catalog), "cell": cell_checksum(self.config.cell, self.config.gripper)}
        return WorldStates(self._groups | recorded, self.physics, origin, self.state.variant, self.state.restarted, self._fresh)

    def get_state(self, worlds: Sequence[int]) -> State:
        """State of worlds; see `WorldStates.get`."""
        return self.states.get(worlds)

    def set_state(self, state: State, worlds: Sequence[int], rows: Sequence[int] | None = None) -> None:
        """Have worlds continue from the rows of a state; see `WorldStates.set`. `record` has the tick in which they were saved."""
        self.states.set(state, worlds, rows)

    def branch(self, world: int, into: Sequence[int]) -> None:
        """Have worlds continue as another does; see `WorldStates.branch`."""
        self.states.branch(world, into)

    def clear_graphs(self) -> None:
        """Drop captured graphs: the next tick launches all kernels one by one, and captures them anew."""
        self.physics.clear_graphs()
        if self.perception is not None:
            self.perception.clear_graphs()

    def restart(self, episodes: Sequence[int]) -> None:
        """Have the worlds that are idle, and others once they are free, run another list of episodes, in order, from the next tick on. The
        former list must be used up. Work is enqueued on the current stream.
        """
        self._former = self.episodes  # Launched kernels may still read it.
        self.episodes = wp.array(np.asarray(episodes, np.int32), dtype=wp.int32, device=self.device)
        self.state.next_episode.zero_()
        arrange.free_idle_worlds(self.state)

    def _arrange(self, resets: bool) -> None:
        """Start episodes in free worlds: objects are sampled and dropped. `resets`: False in the first tick."""
        state, scene, physics, seed = self.state, self.scene, self.physics, self.config.bake.seed
        arrange.assign_episodes(state, self.episodes, self.config.settle.tries)
        if resets:
            self._states.reset(state.phase)
        arrange.sample_episodes(scene, state, seed)
        arrange.drop_objects(scene, state, physics, seed)
        arrange.place_bins(scene, state, physics)
        gripper.set_shaft_collision(scene, state, physics)
        gripper.clear_seals(state, self.seals)
        self.seals.peak.zero_()
        if self.recorder is not None:
            self.recorder.begin_tick()

    def _judge(self) -> None:
        """Update phases and tasks after physics, remove objects that were picked or lost, and end episodes."""
        state, scene, physics, seed = self.state, self.scene, self.physics, self.config.bake.seed
        arrange.judge_settling(scene, state, physics, seed, self.config.settle.restless)
        arrange.place_bins(scene, state, physics)
        gripper.begin_moving(scene, state, physics, seed)
        gripper.begin_picking(scene, state, self.attempts, self.observation, self.plan, physics)
        gripper.remove_lost(scene, state, self.attempts, self.seals, physics)
        if self.hold is not None:
            self.hold.engage(scene, state, self.attempts, self.seals, physics)
            gripper.advance_tasks(scene, state, self.attempts, self.seals, self.plan, physics, self.behavior.law)
        gripper.park_removed(scene, state, self.attempts, physics)
        physics.refresh_poses()
        arrange.judge_episodes(scene, state, self.attempts, self.observation, physics)
        if self.sleep is not None:
            self.sleep.judge(state, self.attempts, self.seals, self.config.physics.sleep)

    def _drive(self, current: newton.State) -> None:
        """Hook before a step: forces of gripper and hold."""
        gripper.drive_gripper(self.scene, self.state, self.attempts, self.plan, self.physics, current, self.behavior.law)
        if self.recorder is not None:
            self.recorder.save_impedance_force()
        if self.hold is not None:
            self.hold.apply_forces(self.scene, self.state, self.seals, self.physics, current)

    def _ignore_contacts(self) -> None:
        """Hook after collision detection: disable contacts that the hold replaces."""
        if self.hold is not None:
            self.hold.ignore_contacts(self.scene, self.state, self.seals, self.physics)

    def _take_snapshot(self) -> None:
        """Copy the state of the worlds into the snapshot of the record, with the previous frame beside it, and pack the status rows."""
        state, snapshot, status, worlds = self.state, self.record.snapshot, self.record.status, self.layout.worlds
        launch(pack.take_snapshot_kernel, worlds, self.scene, state, self.attempts, self.physics.state, snapshot)
        tables = {"status_out": status.table, "measure_out": status.measures}
        launch(pack.pack_status_kernel, worlds, snapshot, state, self.attempts, self.seals, self.plan, **tables)
        launch(pack.copy_sets_kernel, status.engaged.shape, self.attempts, out=status)
        launch(pack.link_frames_kernel, worlds, self.scene, snapshot, self.last)
        wp.copy(snapshot.bin, state.bin)
        wp.copy(snapshot.light, state.light)
        wp.copy(snapshot.light_yaw, state.light_yaw)
        wp.copy(snapshot.light_exposure, state.light_exposure)
