"""Grasp trials: executes many grasps in parallel, each from a saved state. Worlds that finish a trial begin the next one immediately."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Task
from synpick_warp.errors import StateError
from synpick_warp.kernels.sim import trials as kernels
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim import gripper
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State

GRASPS = struct_arrays(kernels.Grasps, "trial", units={"point": "m", "yaw": "rad", "tilt": "rad"})
LABELS = struct_arrays(kernels.Labels, "trial", units={"peak_force": "N", "farthest": "m", "ticks": "ticks", "held": "ticks"})
PROGRESS = struct_arrays(kernels.Progress, "world", pose=("world", "instance"), units={"peak_force": "N", "pose": "m"})
MOVED = 5e-3
"""Displacement above which another object counts as moved [m]; resting piles creep by far less."""
POLL = 8
"""Polling interval for completion of all trials [ticks]."""


class Trials:
    """Runs trials in the worlds of a simulation, which simulates nothing else meanwhile.

    Attributes:
        grasps: The struct `Grasps`.
        labels: The struct `Labels`, complete once `run` returns.
    """

    def __init__(self, simulation: Simulation, state: State, grasps: Mapping[str, np.ndarray]) -> None:
        """Upload the grasps.

        Args:
            simulation: The worlds, after a tick; they may belong to a simulation of other episodes than the state. Its perception is not
                used.
            state: States at moments of choice: an attempt has been planned, and has made no step (`find_choices`).
            grasps: Arrays of `Grasps` by name.

        Raises:
            StateError: Arrays are missing or of other lengths, a row does not exist, or a number is not finite.
        """
        self.simulation, self.state = simulation, state
        self.states, self.device = simulation.states, simulation.device
        self.count = check_grasps(grasps, len(state), simulation.layout.instances)
        sizes = {"trial": self.count, "world": simulation.layout.worlds, "instance": simulation.layout.instances}
        self.grasps, self.labels, self._progress = (allocate_struct(kind, sizes, self.device) for kind in (GRASPS, LABELS, PROGRESS))
        for name in kernels.Grasps.vars:
            getattr(self.grasps, name).assign(np.asarray(grasps[name]))
        self._progress.trial.fill_(-1)
        self._next, self._done = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))
        self._row = wp.zeros(simulation.layout.worlds, dtype=wp.int32, device=self.device)

    def run(self) -> dict[str, np.ndarray]:
        """Run all trials; returns the labels by name."""
        while int(self._done.numpy()[0]) < self.count:
            for _ in range(POLL):
                self.tick()
        return {name: getattr(self.labels, name).numpy() for name in kernels.Labels.vars}

    def tick(self) -> None:
        """Begin trials in free worlds, advance all worlds by one tick, and label what has ended. Only launches kernels."""
        simulation, worlds = self.simulation, self.simulation.layout.worlds
        state, attempts, plan, physics = simulation.state, simulation.attempts, simulation.plan, simulation.physics
        given: dict[str, Any] = {"progress": self._progress, "grasps": self.grasps}
        launch(kernels.assign_trials_kernel, 1, **given, next=self._next, row_out=self._row)
        self.states.load(self.state, self._row)
        sources = (simulation.scene, state, attempts, plan, physics.state)
        launch(kernels.begin_trials_kernel, worlds, *sources, **given, row=self._row)
        gripper.place_grippers(simulation.scene, state, attempts, plan, physics, simulation.behavior.law)
        simulation.tick(perceives=False)
        sources = (simulation.scene, state, attempts, simulation.seals, physics.state)
        given |= {"labels": self.labels, "done": self._done, "moved_distance": MOVED}
        launch(kernels.judge_trials_kernel, worlds, *sources, **given)


def find_choices(simulation: Simulation) -> np.ndarray:
    """Worlds at a moment of choice: an attempt has been planned in this tick, and begins with the next one. Waits for the device."""
    task, steps = simulation.attempts.task.numpy(), simulation.attempts.steps.numpy()
    return np.flatnonzero((task == Task.APPROACH) & (steps == 0))


def own_grasps(simulation: Simulation, worlds: Sequence[int]) -> dict[str, np.ndarray]:
    """Grasps that worlds have planned themselves, with rows in the order of the worlds. Waits for the device."""
    plan = simulation.plan
    arrays = {name: getattr(plan, name).numpy()[np.asarray(worlds, int)] for name in ("target", "point", "normal", "yaw", "tilt")}
    return {"row": np.arange(len(worlds), dtype=np.int32)} | arrays


def check_grasps(grasps: Mapping[str, np.ndarray], rows: int, instances: int) -> int:
    """Number of grasps; raises StateError as `Trials`."""
    shapes = {name: (3,) if name in ("point", "normal") else () for name in kernels.Grasps.vars}
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
