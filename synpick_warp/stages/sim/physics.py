"""Wrapper of Newton's solver and collision pipeline: time stepping, and new objects in a world without a new model."""

import itertools
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, Protocol

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.configs.schema import Physics as PhysicsConfig
from synpick_warp.kernels.sim import arrangement, gripper, rest
from synpick_warp.kernels.state import Contacts
from synpick_warp.newton_patches import KNOWN_NEWTON
from synpick_warp.newton_patches.broad_phase import replace_broad_phase
from synpick_warp.newton_patches.narrow_phase import complete_matching, rank_contacts, resize_blocks, small_blocks
from synpick_warp.newton_patches.solver import FusedSteel, choose_solver
from synpick_warp.scenes import build
from synpick_warp.stages.arrays import bundle
from synpick_warp.stages.launch import launch
from synpick_warp.system.hardware.cores import is_only_launcher

# Sentinel: default of `next` for an exhausted iterator.
ENDED = object()
# Contacts with a larger gap get no constraint rows [m]. The collision pipeline finds none that far apart: a hook disables a contact so.
CONTACT_GAP = 0.1
# Distance to a joint limit from which its constraint row is active [rad].
JOINT_LIMIT_GAP = 0.2
# Fraction of its speed limit from which a body has velocity limit rows. Six idle rows for each body at all times would take a third
# of the solver's time on a GPU.
VELOCITY_LIMIT_FRACTION = 0.5
# On an H200, models of one and two worlds round differently from those of 8, 64 and 512, which agree bit by bit.
MIN_GPU_WORLDS = 8
# Maximum worlds if `bake.worlds` is 0. On a GPU more worlds need memory and hide more of the latency of physics, which rendering hides as
# well; on a CPU worlds are simulated one after the other, so that more of them gain nothing.
MAX_GPU_WORLDS, MAX_CPU_WORLDS = 512, 4


def balance_worlds(episodes: int, limit: int) -> int:
    """Fewest worlds that run `episodes` in as few rounds as `limit` worlds do: for 600 episodes two rounds of 300, not 512 and 88."""
    return -(-episodes // -(-episodes // limit)) if episodes else 1


def with_enough_worlds(config: Config, device: wp.Device, episodes: int | None = None) -> Config:
    """Resolve `bake.worlds`: as set, or if 0 from the number of episodes that the device simulates, None: all of the settings; on a GPU at
    least MIN_GPU_WORLDS.

    Automatic: balanced rounds (`balance_worlds`). If all episodes fit, they run at once: physics ends with the longest of them, and may be
    ahead of the renderer from the start (`TickLoop`). The minimum keeps episodes independent of the number of worlds; surplus worlds idle.
    """
    worlds = config.bake.worlds
    if not worlds:
        count = DataLayout.of(config).planned if episodes is None else episodes
        worlds = balance_worlds(count, MAX_GPU_WORLDS if device.is_cuda else MAX_CPU_WORLDS)
    worlds = max(worlds, MIN_GPU_WORLDS) if device.is_cuda else worlds
    return config if worlds == config.bake.worlds else config.with_values({"bake.worlds": worlds})


class Watcher(Protocol):
    """Observer of the steps of a tick. Its launches are captured in graphs, as those of the hooks of `Physics.tick`."""

    def begin_step(self) -> None:
        """Called before a physics step."""

    def after_solve(self, contact_f: wp.array) -> None:
        """Called after each solver substep; `contact_f` holds each contact's force on its first shape (contact) spatial vector [N]."""

    def end_step(self, step: int, current: newton.State) -> None:
        """Called after a step; `step` is its index in the tick, `current` the state at its end."""


class Sleepers(Protocol):
    """Bodies that a substep leaves out. Its launches are captured in graphs."""

    def touch(self) -> None:
        """Called between collision detection and solver."""

    def hold(self, before: newton.State, after: newton.State) -> None:
        """Called after the solver, with the states before and after the substep."""


class Physics:
    """Newton's model, state, solver and collision pipeline. `state` is the current state before and after `tick`.

    Drive targets are laid out as joint coordinates: `control.joint_target_q[w * coords + 3]` is the tilt target of world w's cup [rad].
    """

    def __init__(self, settings: PhysicsConfig, built: build.BuiltModel) -> None:
        self.settings, self._rest_gap = settings, built.rest_gap
        self.layout = built.layout
        self.model = built.model
        self.device = self.model.device
        worlds = built.layout.worlds
        self.pipeline = make_pipeline(settings, self.model)
        self.contacts = self.pipeline.contacts()
        self.solver = make_solver(settings, self.model, built.layout.slots)
        self.state = self.model.state()
        self._other = self.model.state()
        self.control = self.model.control()
        self.lost = wp.zeros(worlds, dtype=wp.int32, device=self.device)
        """Bits of `Lost` of each world since the last judgement of episodes (world) int32."""
        self.solver_stream: wp.Stream | None = None
        """CUDA stream for the captured kernels of the solver, from the next tick on; None: the current stream. It may be confined to few
        multiprocessors, since these kernels are short and small, while those of collision detection need many."""
        self.sleepers: Sleepers | None = None
        """None: all bodies are simulated."""
        self._first_radius, self._first_transform = wp.clone(self.model.shape_collision_radius), wp.clone(self.model.shape_transform)
        self._graphs: dict[wp.Stream | None, list[wp.Graph]] = {}
        self._observables = self.solver.observables({self.solver.ObservableKind.CONTACT_F}, contacts=self.contacts)
        fingers = np.arange(worlds) * built.layout.bodies_per_world
        self._finger_joint = wp.array(
            np.argsort(self.model.joint_child.numpy(), kind="stable")[fingers], dtype=wp.int32, device=self.device
        )

    def set_yaw(self, yaw: wp.array) -> None:
        """Set the yaw of each gripper shaft and its cup about the vertical through the wrist, counter-clockwise from above (world) float32
        [rad]; x, y and z stay the world's axes.

        Takes effect in the next step, and in body poses after `refresh_poses`. Nothing is read back from the device."""
        launch(gripper.set_yaw_kernel, self.layout.worlds, finger_joint=self._finger_joint, yaw=yaw, joint_child_out=self.model.joint_X_c)
        self.solver.notify_model_changed(newton.ModelFlags.JOINT_PROPERTIES)

    def load(self, variant: wp.array, restarted: wp.array) -> None:
        """Select body variants (body) int32, -1: no change, and reset solver history and contact matching of restarted worlds (world + 1)
        bool, after joint coordinates were written."""
        self.select(variant, restarted)
        self.pipeline.reset_contact_matching(restarted)
        self.refresh_poses()

    def select(self, variant: wp.array, restarted: wp.array) -> None:
        """Select body variants and reset solver history, as `load` does, but without contact matching and poses.

        What a world simulates then does not depend on what it had before: shapes that a variant leaves unused are those of a new model.
        """
        model = self.model
        inputs = [model.shape_body, self._first_radius, self._first_transform, model.body_variant, variant]
        outputs = [model.shape_collision_radius, model.shape_transform]
        wp.launch(arrangement.reset_shapes_kernel, dim=model.shape_count, inputs=inputs, outputs=outputs, device=self.device)
        flags = model.select_body_variants(variant)
        self.solver.notify_model_changed(flags, world_mask=restarted)
        self.solver.reset(self.state, world_mask=restarted)

    def refresh_poses(self) -> None:
        """Compute body poses from joint coordinates (forward kinematics)."""
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def tick(
        self, before_step: Callable[[newton.State], None], after_collide: Callable[[], None] | None = None, watcher: Watcher | None = None
    ) -> None:
        """Advance all worlds by one tick; arguments as in `tick_parts`."""
        for _ in self.tick_parts(before_step, after_collide, watcher):
            pass

    def tick_parts(
        self, before_step: Callable[[newton.State], None], after_collide: Callable[[], None] | None = None, watcher: Watcher | None = None
    ) -> Iterator[None]:
        """Advance all worlds by one tick, `steps_per_tick` x `substeps` substeps: a generator that yields after each substep, or graph.

        While there are no graphs, a tick's first period (see `_period`) runs eagerly on the current stream: it loads kernels and triggers
        Newton's late allocations. Then a period is captured and replayed: a CUDA graph per substep, or on the CPU one list of launches that
        Warp replays in C++, which saves the 30 us of each launch in Python. Each `solver_stream` has graphs of its own.

        `before_step` launches kernels that write the control's forces from a state, before each step; `after_collide` kernels that edit
        `contacts` before the solver reads them; `watcher` kernels that record the steps. Replays skip hooks and watcher, so they must
        launch the same kernels on the same arrays in every tick, hooks in every step. On the CPU, Warp finds a captured kernel by its key:
        closures and overloads of one name in a module would replace each other."""
        stream, period = self.solver_stream, self._period(watcher)
        periods = self.settings.steps_per_tick * self.settings.substeps // period
        eager = self._run_substeps(before_step, after_collide, watcher)
        if not self._graphs:
            self._open_branch(None)
            yield from itertools.islice(eager, period)
            periods -= 1
        if stream not in self._graphs:
            if not may_capture(self.device):
                yield from eager
                return
            self._open_branch(stream)
            self._graphs[stream] = self._capture(itertools.islice(self._run_substeps(before_step, after_collide, watcher, stream), period))
        for graph in self._graphs[stream] * periods:
            wp.capture_launch(graph)
            yield

    def _open_branch(self, stream: wp.Stream | None) -> None:
        """Have the solver use two streams on a GPU, of which one is `stream`, None: the current one."""
        if self.device.is_cuda and isinstance(self.solver, FusedSteel):
            self.solver.open_branch(stream or wp.get_stream(self.device))

    def _period(self, watcher: Watcher | None) -> int:
        """Period of the launches [substeps]: a step, or with a watcher, whose launches differ between steps, a tick."""
        return self.settings.substeps * (1 if watcher is None else self.settings.steps_per_tick)

    def _capture(self, substeps: Iterator[None]) -> list[wp.Graph]:
        """Capture a period: a CUDA graph of each substep, or on the CPU one for all, as each CPU graph keeps copies of filled arrays.

        A single CUDA graph of a whole tick could not be enqueued in parts, and CUDA would spread it over 66 streams.
        """
        each = 1 if self.device.is_cuda else None
        graphs: list[wp.Graph] = []
        while True:
            with wp.ScopedCapture(device=self.device) as capture:
                count = sum(1 for _ in itertools.islice(substeps, each))
            if not count:
                return graphs
            graphs.append(capture.graph)

    def clear_graphs(self) -> None:
        """Drop the captured graphs; the next tick begins eagerly, and captures them anew."""
        self._graphs = {}

    @property
    def overlap_count(self) -> wp.array:
        """Number of pairs of shapes of all worlds whose bounding boxes overlap (one) int32; with Newton's broad phase those it keeps."""
        return getattr(self.pipeline.broad_phase, "overlap_count", self.pipeline.broad_phase_pair_count)

    def flag_lost(self) -> None:
        """Flag worlds that lost pairs of shapes or contacts: Newton drops pairs silently, and its solver flags contacts and rows alike."""
        pipeline, contacts = self.pipeline, self.contacts
        pairs, found = pipeline.broad_phase_shape_pairs, pipeline.broad_phase_pair_count
        wp.launch(
            rest.flag_lost_kernel,
            dim=self.layout.worlds,
            inputs=[pairs.shape[0], contacts.rigid_contact_max, self.overlap_count, found, contacts.rigid_contact_count],
            outputs=[self.solver.constraint_overflow, self.lost],
            device=self.device,
        )

    def _set_gaps(self, state: newton.State) -> None:
        """Set the contact margins of all shapes by the speeds of their bodies; a fast one and one at rest sum to twice the gap at most."""
        physics, model = self.settings, self.model
        duration = physics.step / physics.substeps
        margins = [self._rest_gap, 2.0 * physics.gap - self._rest_gap, duration, duration * physics.gravity]
        inputs = [*margins, model.shape_body, model.shape_transform, model.shape_collision_radius, model.body_com, state.body_qd]
        wp.launch(rest.set_gaps_kernel, dim=model.shape_count, inputs=inputs, outputs=[model.shape_gap], device=self.device)

    def _run_substeps(
        self,
        before_step: Callable[[newton.State], None],
        after_collide: Callable[[], None] | None,
        watcher: Watcher | None,
        solver_stream: wp.Stream | None = None,
    ) -> Iterator[None]:
        """Enqueue a tick; yields after each substep. The last one of a step leaves its result in `state`, so that all steps are the same.
        Hooks and watcher as in `tick_parts`, `solver_stream` as the attribute."""
        current, following = self.state, self._other
        physics, observables = self.settings, self._observables if watcher is not None else None
        for step, substep in itertools.product(range(physics.steps_per_tick), range(physics.substeps)):
            with small_blocks():
                if substep == 0:
                    if watcher is not None:
                        watcher.begin_step()
                    before_step(current)
                self._set_gaps(current)
                self.pipeline.collide(current, self.contacts)
                self.flag_lost()
                if self.sleepers is not None:
                    self.sleepers.touch()
                if after_collide is not None:
                    after_collide()
                duration = physics.step / physics.substeps
                with wp.ScopedStream(solver_stream, sync_exit=True):
                    self.solver.step(current, following, self.control, self.contacts, duration, observables=observables)
                if self.sleepers is not None:
                    self.sleepers.hold(current, following)
                current, following = following, current
                ends_step = substep + 1 == physics.substeps
                if ends_step and current is not self.state:
                    self.state.assign(current)
                    current, following = self.state, self._other
                if watcher is not None:
                    watcher.after_solve(self._observables.contact_f)
                    if ends_step:
                        watcher.end_step(step, current)
            yield


def may_capture(device: wp.Device) -> bool:
    """Whether physics is captured in graphs on a device.

    On the CPU only for the known version of Newton, and while no other thread may launch kernels: Warp's recorder also collects the arrays
    of launches in other threads, without a lock.
    """
    return device.is_cuda or (newton.__version__ == KNOWN_NEWTON and is_only_launcher())


def make_pipeline(physics: PhysicsConfig, model: newton.Model) -> newton.CollisionPipeline:
    """Collision pipeline of all worlds of a model, with the capacities of the settings."""
    model.rigid_contact_max = physics.contacts_per_world * model.world_count
    # Matching contacts with those of the previous step sorts them, so that their order is deterministic.
    pipeline = newton.CollisionPipeline(
        model,
        broad_phase="nxn",
        contact_matching="latest",
        rigid_contact_max=model.rigid_contact_max,
        shape_pairs_max=physics.pairs_per_world * model.world_count,
        verify_buffers=False,
    )
    if newton.__version__ != KNOWN_NEWTON:
        return pipeline
    if physics.match_all:
        complete_matching(pipeline)
    replace_broad_phase(pipeline)
    rank_contacts(pipeline)
    resize_blocks(pipeline)
    return pipeline


def make_solver(physics: PhysicsConfig, model: newton.Model, slots: int) -> newton.solvers.SolverSteel:
    """Rigid-body solver of all worlds of a model with `slots` free bodies a world."""
    return choose_solver(model.device)(
        model,
        iterations=physics.iterations,
        contact_warmstart=True,
        contact_gap_gate=CONTACT_GAP,
        articulation_constraint_max=physics.gripper_rows_per_world,
        enable_joint_limits=True,
        joint_limit_activation_gap=JOINT_LIMIT_GAP,
        velocity_limit_activation_fraction=VELOCITY_LIMIT_FRACTION,
        warn_constraint_overflow=False,
        **_sweep(physics, slots, model.device.is_cuda),
    )


def _sweep(physics: PhysicsConfig, slots: int, parallel: bool) -> dict[str, Any]:
    """Options of the Gauss-Seidel sweep over a world's constraint rows: graph-colored and parallel on a GPU, sequential on the CPU.

    On an H200, 512 worlds take 10.9 ms a step with colors and 14.6 ms without, and come to rest equally well.
    """
    if not parallel:
        return {"free_body_constraint_max": physics.rows_per_world}
    # Contacts have rows of their own; the remaining rows of free bodies are velocity limits.
    return {
        "solve_mode": "colored",
        "articulated_contact_response": "propagation",
        "propagation_cached_response": False,
        "propagation_constraint_max": physics.rows_per_world,
        "free_body_constraint_max": build.FREE_DOFS * slots,
        "deterministic": wp.DeterministicMode.RUN_TO_RUN if physics.deterministic else wp.DeterministicMode.NOT_GUARANTEED,
    }


def contact_arrays(physics: Physics) -> Any:
    """The struct `Contacts`: arrays of the contacts, and the body of each shape."""
    arrays = {name: getattr(physics.contacts, f"rigid_contact_{name}") for name in Contacts.vars if name != "shape_body"}
    return bundle(Contacts, SimpleNamespace(**arrays), physics.model)
