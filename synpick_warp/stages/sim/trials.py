"""Grasp trials: runs many grasps in parallel, each from a saved state; a work queue gives worlds that finish a trial the next one.

States are saved at moments of choice: ends of ticks in which an attempt was planned; the attempt begins with the next tick.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import newton
import numpy as np
import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.configs.episodes.manipulation import Pick, Picks
from synpick_warp.configs.schema import Physics as PhysicsConfig
from synpick_warp.errors import StateError
from synpick_warp.kernels.grasps import Grasps, PerturbationData, Perturbations
from synpick_warp.kernels.perception.perturbations import plan_trials_kernel
from synpick_warp.kernels.sim import trials as kernels
from synpick_warp.kernels.sim.trials import list_choices_kernel
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.constants import SceneData, fill
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.images import Plan
from synpick_warp.stages.sim import gripper
from synpick_warp.stages.sim.behavior import Hold
from synpick_warp.stages.sim.physics import MAX_CPU_WORLDS, MIN_GPU_WORLDS, Physics
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState
from synpick_warp.stages.stream import TickReport
from synpick_warp.stages.timing import scope
from synpick_warp.views.picks import MOVED

GRASPS = struct_arrays(Grasps, "grasp", units={"point": "m", "yaw": "rad", "tilt": "rad"})
PERTURBATIONS = struct_arrays(Perturbations, "trial", units={"offset": "m", "rotation": "rad"})
LABELS = struct_arrays(kernels.Labels, "trial", units={"peak_force": "N", "farthest": "m", "ticks": "ticks", "held": "steps"})
_SHAPES = {"pose": ("world", "instance"), "next": ("one",), "done": ("one",)}
PROGRESS = struct_arrays(kernels.Progress, "world", units={"peak_force": "N", "pose": "m"}, **_SHAPES)
GPU_WORLDS = 2048
"""Maximum number of trial worlds on a GPU if `picks.worlds` is 0. On an H200, 512 worlds run 293 trials of the synpick preset a second,
2,048 worlds more than 530."""
ROUNDS = 8
"""Least trials per world of a bake, by which the number of trial worlds is chosen."""
BATCH_ROUNDS = 32
"""Trials per world of a batch. At its end all worlds wait for the slowest: with trials of the synpick preset they are busy for 98 % of the
time, but for 92 % with 8 per world."""
POLL = 8
"""Polling interval for completion of all trials [ticks]."""


class TrialLaw(gripper.TwoSpeedLaw):
    """Setpoint law of trials: the paper's two speeds, but the gripper appears near the grasp and holds after the lift, and the attempt
    ends once nothing is attached.
    """

    def __init__(self, course: Any) -> None:
        """Take the struct `TrialData`."""
        self.course = course

    def begin(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics) -> None:
        """Place the gripper near the grasp, or where an attempt begins."""
        if self.course.near == 0.0:
            super().begin(scene, state, attempts, plan, physics)
            return
        sources = (scene, state, attempts, plan, physics.state, physics.control)
        launch(kernels.place_near_kernel, len(state.phase), *sources, course=self.course)

    def end_tick(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """Task transitions: end PRESS by time, and LIFT after the hold or once nothing is attached."""
        launch(kernels.advance_trials_kernel, len(state.phase), scene, state, attempts, plan, course=self.course)


class WatchedHold:
    """Decorator of a hold that counts in the struct `Progress` how long it holds, in each step."""

    def __init__(self, hold: Hold, progress: Any) -> None:
        self.hold, self.progress = hold, progress
        self.engage, self.ignore_contacts = hold.engage, hold.ignore_contacts

    def apply_forces(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics, current: newton.State) -> None:
        """Apply the seal forces, then update steps held."""
        self.hold.apply_forces(scene, state, seals, physics, current)
        launch(kernels.watch_seals_kernel, len(state.phase), seals, progress=self.progress)


class Trials:
    """Executor of grasp trials in the worlds of a simulation, which runs nothing else afterwards. `course` and `spread` are the structs
    `TrialData` and `PerturbationData`."""

    def __init__(self, simulation: Simulation, settings: Picks) -> None:
        """Take over a simulation that has ticked once, with the settings of `trial_values`; its perception is not used."""
        self.simulation, self.device = simulation, simulation.device
        self.states = simulation.states
        assert simulation.hold is not None
        self.course = make_course(settings, simulation.config.physics, simulation.config.pick)
        seed = wp.uint64(simulation.config.bake.seed)
        self.spread = fill(PerturbationData, settings, angle=math.radians(settings.angle), seed=seed)
        sizes = {"world": simulation.layout.worlds, "instance": simulation.layout.instances, "one": 1}
        self._progress = allocate_struct(PROGRESS, sizes, self.device)
        self._progress.trial.fill_(-1)
        simulation.behavior = replace(simulation.behavior, law=TrialLaw(self.course))
        simulation.hold = WatchedHold(simulation.hold, self._progress)
        simulation.clear_graphs()

    def upload(self, grasps: Mapping[str, np.ndarray], rows: int) -> Any:
        """Copy grasps to the device: fields of `Grasps` by name, each (grasp[, 3]), for a state of `rows` rows; returns the struct. Raises
        StateError if an array is missing or has another shape, a row or target is out of range, or a number is not finite."""
        count = check_grasps(grasps, rows, self.simulation.layout.instances)
        result = allocate_struct(GRASPS, {"grasp": count}, self.device)
        for name in Grasps.vars:
            getattr(result, name).assign(np.asarray(grasps[name]))
        return result

    def run(self, state: State, grasps: Any) -> dict[str, np.ndarray]:
        """Run all trials of grasps (the struct `Grasps`). Waits for the device.

        States are at moments of choice: an attempt is planned and has made no step; also of other simulations of the same
        objects. Returns the fields of `Labels` and `Perturbations` by name (trial, ...), with `repeats` consecutive trials of each grasp.
        """
        sizes = {"trial": len(grasps.row) * self.course.repeats}
        labels, perturbations = (allocate_struct(kind, sizes, self.device) for kind in (LABELS, PERTURBATIONS))
        self._progress.next.zero_()
        self._progress.done.zero_()
        while int(self._progress.done.numpy()[0]) < sizes["trial"]:
            for _ in range(POLL):
                self.tick(state, grasps, labels, perturbations)
        return {name: getattr(part, name).numpy() for part in (labels, perturbations) for name in part._cls.vars}

    def tick(self, state: State, grasps: Any, labels: Any, perturbations: Any) -> None:
        """Begin trials in free worlds, advance all worlds by one tick, and write labels of trials that end. Only launches kernels."""
        simulation, progress, worlds = self.simulation, self._progress, self.simulation.layout.worlds
        scene, physics, plan = simulation.scene, simulation.physics, simulation.plan
        sources = (scene, simulation.state, simulation.attempts)
        with scope("load states", self.device):
            numbers = {"count": len(labels.outcome), "repeats": self.course.repeats}
            launch(kernels.assign_trials_kernel, 1, progress=progress, grasps=grasps, **numbers)
            self.states.load(state, progress.row)
            planned = {"spread": self.spread, "trial": progress.trial, "grasps": grasps, "perturbations": perturbations}
            launch(plan_trials_kernel, worlds, *sources, row=progress.row, **planned, out=plan)
            launch(kernels.begin_trials_kernel, worlds, *sources, physics.state, progress=progress)
            given = {"progress": progress, "friction": perturbations.friction, "mu": physics.model.shape_material_mu}
            launch(kernels.set_friction_kernel, (worlds, simulation.layout.shapes_per_world), scene, course=self.course, **given)
            gripper.place_grippers(scene, simulation.state, simulation.attempts, plan, physics, simulation.behavior.law)
        simulation.tick(perceives=False)
        given = {"course": self.course, "grasps": grasps, "labels": labels, "progress": progress}
        launch(kernels.judge_trials_kernel, worlds, *sources, simulation.seals, physics.state, **given)


def count_trial_worlds(picks: Picks, episodes: int, device: wp.Device) -> int:
    """Number of trial worlds of a bake of `episodes` episodes: `picks.worlds`; 0: ROUNDS trials per world, within the device's limits."""
    most = episodes * picks.states * picks.candidates * picks.repeats
    worlds = picks.worlds or min(-(-most // ROUNDS), GPU_WORLDS if device.is_cuda else MAX_CPU_WORLDS)
    return max(worlds, MIN_GPU_WORLDS) if device.is_cuda else worlds


def trial_values(picks: Picks, worlds: int) -> dict[str, Any]:
    """Settings of a simulation for trials, by full key; episodes are not retried (`settle.tries`)."""
    return {"bake.worlds": worlds, "pick.lift_height": picks.lift_height, "settle.tries": 1, "bop.graph": False}


def make_course(settings: Picks, physics: PhysicsConfig, pick: Pick) -> Any:
    """Convert settings to the struct `TrialData`: times from seconds to steps or ticks of a simulation.

    Outcomes are judged at the ends of ticks: the hold is such that lift and hold together take the nearest number of them.
    """
    lift = math.ceil(pick.lift_height / (pick.lift_speed * physics.step))
    ticks = round((lift + settings.hold / physics.step) / physics.steps_per_tick)
    return fill(
        kernels.TrialData,
        settings,
        lift_steps=lift,
        hold_steps=max(ticks * physics.steps_per_tick - lift, 0) if settings.hold > 0.0 else 0,
        settle_ticks=math.ceil(settings.settle / physics.tick_time),
        moved_distance=MOVED,
        base_friction=physics.friction,
    )


def check_grasps(grasps: Mapping[str, np.ndarray], rows: int, instances: int) -> int:
    """Validate the arguments of `Trials.upload`; returns the number of grasps, or raises its StateError."""
    shapes = {name: (3,) if name in ("point", "normal") else () for name in Grasps.vars}
    if missing := shapes.keys() - grasps.keys():
        raise StateError(f"grasps lack {sorted(missing)[0]}")
    count = len(np.atleast_1d(grasps["row"]))
    for name, shape in shapes.items():
        values = np.asarray(grasps[name])
        if values.shape != (count, *shape):
            raise StateError(f"{name} of {count} grasps has the shape {values.shape}, not {(count, *shape)}")
        if not np.isfinite(values).all():
            raise StateError(f"{name} of grasp {int(np.argwhere(~np.isfinite(values))[0][0])} is not finite")
    for name, low, high in (("row", 0, rows), ("target", -1, instances)):
        values = np.asarray(grasps[name])
        if wrong := [value for value in values if not low <= value < high]:
            raise StateError(f"{name} is {wrong[0]}; allowed: {low} to {high - 1}")
    return count


@dataclass(frozen=True)
class Choice:
    """Key of a saved state: row of the ring buffer, episode and arrangement index, index among the episode's states, and frame."""

    row: int
    episode: int
    arrangement: int
    state: int
    frame: int


class ChoiceRecorder:
    """Writer of the ring buffer: saves the states of worlds at a moment of choice at the end of each tick of a simulation, up to `states`
    of an episode, in `rows` rows; a row is overwritten `rows` saved states later.

    Does not report to the host which states it saved: `ChoiceReader` applies the same rule to the reports of ticks."""

    def __init__(self, simulation: Simulation, states: int, rows: int) -> None:
        """Record a simulation from its next tick on."""
        self.states, self.rows, self.simulation = states, rows, simulation
        device = simulation.device
        self._stride = wp.zeros(simulation.layout.worlds, dtype=wp.int32, device=device)
        self._next = wp.zeros(1, dtype=wp.int32, device=device)
        self._world = wp.zeros(rows, dtype=wp.int32, device=device)
        self._ring: State | None = None
        simulation.after_tick = self.save

    @property
    def ring(self) -> State:
        """The ring buffer, allocated at first use, which must follow the first tick."""
        if self._ring is None:
            self._ring = self.simulation.checkpoints.allocate(self.rows)
        return self._ring

    def save(self) -> None:
        """Save the states of worlds at a moment of choice. Only launches kernels."""
        simulation, ring = self.simulation, self.ring
        sources = (simulation.scene, simulation.state, simulation.attempts)
        launch(list_choices_kernel, 1, *sources, states=self.states, stride=self._stride, next=self._next, world_out=self._world)
        simulation.checkpoints.save(ring, self._world)


class ChoiceReader:
    """Derives from the reports of ticks which states a `ChoiceRecorder` has saved, and in which rows. Must read every report, in order."""

    def __init__(self, recorder: ChoiceRecorder, labelled: int) -> None:
        """Read from the first tick of `recorder` on; `labelled`: number of catalog objects with labels, which come first."""
        self.states, self.rows, self.labelled = recorder.states, recorder.rows, labelled
        self._strides = np.ones(recorder.simulation.layout.worlds, int)
        self._next = 0

    def read(self, report: TickReport) -> list[Choice]:
        """States saved in a tick, in order of rows."""
        looks = (report.column("phase") == Phase.ACT) & (report.column("task") == Task.LOOK)
        found = []
        for world in np.flatnonzero(looks).tolist():
            attempt = int(report.column("attempt")[world]) + 1
            if attempt == 0:
                index = report.catalog_index[world]
                self._strides[world] = max(1, -(-int(((index >= 0) & (index < self.labelled)).sum()) // self.states))
            state, rest = divmod(attempt, int(self._strides[world]))
            if report.plan.target[world] >= 0 and rest == 0 and state < self.states:
                episode, arrangement, frame = (int(report.column(name)[world]) for name in ("episode", "arrangement", "frame"))
                found.append(Choice(self._next % self.rows, episode, arrangement, state, frame))
                self._next += 1
        return found
