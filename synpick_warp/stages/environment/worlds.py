"""Worlds of the vector environment: attempts of different lengths, ticks of twists, resets from the bank of piles, branches.

A world whose attempt has ended is saved in that tick; when all have ended, every world is loaded as it was saved. So what a world does
depends neither on the others nor on how long these take.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Outcome
from synpick_warp.errors import StateError
from synpick_warp.kernels.environment import attempts as kernels
from synpick_warp.kernels.environment.grasps import plan_grasps_kernel
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.environment.piles import POLL, PileBank
from synpick_warp.stages.environment.sight import Sight
from synpick_warp.stages.environment.twist import TwistLaw
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim import gripper
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State
from synpick_warp.views.picks import MOVED

RESULTS = struct_arrays(kernels.Results, "world", pose=("world", "instance"), units={"peak_force": "N", "farthest": "m", "pose": "m"})
SHOWN = ("outcome", "picked", "hits", "peak_force", "ticks", "moved", "farthest", "lost")
"""Fields of `Results` that are copied to the host."""
LONGEST = 4096
"""Timeout of an attempt [ticks], which is never reached: setpoints arrive long before."""


class EnvironmentWorlds:
    """Simulated worlds that advance by an action at a time. The first `count` are environments; others pad the batch on a GPU, idle.

    Attributes:
        simulation: The simulation, whose list of episodes is empty.
        bank: Checkpoint bank of settled piles.
        sight: Observations.
    """

    def __init__(self, simulation: Simulation, sight: Sight, count: int, piles: int, law: TwistLaw | None, targets: bool) -> None:
        """
        Args:
            simulation: The worlds, before their first tick.
            sight: Observations of them.
            count: Number of environments.
            piles: Capacity of the bank; raised to what resets need.
            law: Twist control, if actions are twists.
            targets: Whether perception chooses a target before each attempt.

        Raises:
            StateError: Memory is too short.
        """
        self.simulation, self.sight, self.count, self.law, self.targets = simulation, sight, count, law, targets
        self.device, worlds = simulation.device, simulation.layout.worlds
        simulation.tick(perceives=False)
        self.bank = PileBank(simulation, max(piles, 2 * count, worlds))
        self._held = simulation.states.allocate(worlds)
        sizes = {"world": worlds, "instance": simulation.layout.instances}
        self._results = allocate_struct(RESULTS, sizes, self.device)
        self._running, self._world, self._instance = (wp.zeros(worlds, dtype=wp.int32, device=self.device) for _ in range(3))
        self._done = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._point, self._direction = (wp.zeros(worlds, dtype=wp.vec3, device=self.device) for _ in range(2))
        self._pixel = wp.zeros(worlds, dtype=wp.vec2i, device=self.device)

    def reset(self, environments: np.ndarray, episodes: Sequence[int], ahead: Sequence[int] = ()) -> None:
        """Load the settled piles of episodes into environments; the others keep their states.

        Args:
            environments: Their indices.
            episodes: Episode index of each.
            ahead: Episodes to prefetch; see `PileBank.fetch`.

        Raises:
            StateError: A pile does not come to rest, or memory is too short.
        """
        states, others = self.simulation.states, np.setdiff1d(np.arange(self.count), environments)
        settles = self.bank.misses(episodes)
        if settles:
            states.save(self._held, self._table(others))
        rows = self.bank.fetch(episodes, ahead)
        if settles:
            states.load(self._held, self._table(others))
        states.load(self.bank.state, self._table(environments, rows))
        self._look()

    def attempt_pixels(self, active: np.ndarray, pixels: np.ndarray) -> dict[str, np.ndarray]:
        """Attempt to pick at pixels (environment, 2) of the last images in active environments; see `_attempt`."""
        self._running.assign(self._padded(active))
        self._pixel.assign(self._padded(pixels))
        self.sight.grasp_pixels(self._pixel, self._point, self._direction, self._instance, self._running)
        return self._attempt(active)

    def attempt_points(self, active: np.ndarray, points: np.ndarray, directions: np.ndarray) -> dict[str, np.ndarray]:
        """Attempt to pick at points (environment, 3) [m], along directions out of the surface, in active environments; see `_attempt`."""
        self._running.assign(self._padded(active))
        self._point.assign(self._padded(points).astype(np.float32))
        self._direction.assign(self._padded(directions).astype(np.float32))
        self._instance.fill_(-1)
        return self._attempt(active)

    def tick(self, active: np.ndarray, commands: np.ndarray) -> dict[str, np.ndarray]:
        """Advance active environments by a tick under commands (environment, column), see `TwistLaw`; results of the tick by name."""
        simulation, law, states = self.simulation, self.law, self.simulation.states
        if law is None:
            raise ValueError("commands are for worlds under twist control")
        law.command.assign(self._padded(commands).astype(np.float32))
        waiting = np.flatnonzero(~active)
        if len(waiting):
            states.save(self._held, self._table(waiting))
        self._running.assign(self._padded(active))
        law.start_tick()
        self._measure()
        simulation.tick(perceives=False)
        self._judge()
        if len(waiting):
            states.load(self._held, self._table(waiting))
        self._look()
        return self._read()

    def status(self) -> tuple[np.ndarray, np.ndarray]:
        """`Phase` and `Ending` of each environment."""
        state = self.simulation.state
        return state.phase.numpy()[: self.count], state.ending.numpy()[: self.count]

    def get_state(self) -> State:
        """Save a checkpoint of the environments, one a row."""
        return self.simulation.get_state(range(self.count))

    def set_state(self, state: State, environments: Sequence[int]) -> None:
        """Load the rows of environments from a checkpoint.

        Raises:
            StateError: The state has another number of rows, or is of other worlds.
        """
        if len(state) != self.count:
            raise StateError(f"the state is of {len(state)} environments, not of {self.count}")
        self.simulation.set_state(state, environments, environments)

    def branch(self, environment: int, into: Sequence[int]) -> None:
        """Copy the state of an environment to those of `into`; raises StateError if one does not exist."""
        if wrong := [index for index in (environment, *into) if not 0 <= index < self.count]:
            raise StateError(f"there is no environment {wrong[0]}; there are 0 to {self.count - 1}")
        self.simulation.branch(environment, into)

    def _attempt(self, active: np.ndarray) -> dict[str, np.ndarray]:
        """Simulate until every attempt has ended; returns the results: arrays (environment, ...) by the names of SHOWN.

        An environment whose pixel shows no surface keeps its state, with outcome NOTHING_SEEN.
        """
        simulation, states = self.simulation, self.simulation.states
        plan = simulation.plan
        given: dict[str, Any] = {"running": self._running, "grasp_point": self._point, "direction": self._direction}
        given |= {"instance": self._instance, "keeps_target": int(self.targets)}
        running = self._running.numpy().copy()
        launch(plan_grasps_kernel, len(running), simulation.scene, out=plan, **given)
        states.save(self._held, self._table(np.flatnonzero(running == 0)))
        self._measure()
        launch(kernels.begin_attempts_kernel, len(running), simulation.attempts, running=self._running)
        gripper.place_grippers(simulation.scene, simulation.state, simulation.attempts, plan, simulation.physics, simulation.behavior.law)
        ticks, count = 0, int(running.sum())
        while int(self._done.numpy()[0]) < count:
            if ticks > LONGEST:
                raise StateError(f"an attempt has not ended after {LONGEST} ticks")
            for _ in range(POLL):
                simulation.tick(perceives=False)
                self._judge()
                simulation.states.save(self._held, self._world)
            ticks += POLL
        states.load(self._held, self._table(np.arange(simulation.layout.worlds)))
        self._look()
        results = self._read()
        results["outcome"] = np.where(active & (running[: self.count] == 0), Outcome.NOTHING_SEEN, results["outcome"])
        return results

    def _measure(self) -> None:
        """Reset the results, and take the current poses as the reference from which motion is measured."""
        simulation = self.simulation
        self._done.zero_()
        sources = (simulation.scene, simulation.state, simulation.attempts, simulation.physics.state)
        launch(kernels.begin_results_kernel, simulation.layout.worlds, *sources, results=self._results)

    def _judge(self) -> None:
        """Update the results of running attempts after a tick."""
        simulation = self.simulation
        sources = (simulation.scene, simulation.state, simulation.attempts, simulation.seals, simulation.physics.state)
        given: dict[str, Any] = {"running": self._running, "results": self._results, "world": self._world, "done": self._done}
        launch(kernels.judge_attempts_kernel, simulation.layout.worlds, *sources, moved_distance=MOVED, **given)

    def _look(self) -> None:
        """Run perception, which chooses targets, in worlds that await an attempt."""
        simulation = self.simulation
        if self.targets and simulation.perception is not None:
            simulation.perception.perceive(simulation.record.snapshot)

    def _read(self) -> dict[str, np.ndarray]:
        """Copy the results of the environments to the host."""
        return {name: getattr(self._results, name).numpy()[: self.count].copy() for name in SHOWN}

    def _table(self, worlds: np.ndarray, rows: Sequence[int] | None = None) -> wp.array:
        """Index table (world) int32: the row of each of `worlds` (None: its own index), -1 elsewhere."""
        table = np.full(self.simulation.layout.worlds, -1, np.int32)
        table[worlds] = worlds if rows is None else rows
        return wp.array(table, dtype=wp.int32, device=self.device)

    def _padded(self, values: np.ndarray) -> np.ndarray:
        """Pad values of the environments (environment, ...) with zeros for the other worlds."""
        padded = np.zeros((self.simulation.layout.worlds, *values.shape[1:]), np.int32 if values.dtype == bool else values.dtype)
        padded[: self.count] = values
        return padded
