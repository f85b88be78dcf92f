"""Physics engines on equal piles: our solver and MuJoCo Warp by Newton's interface, MuJoCo in threads."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any, Protocol

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.schema import Physics, Tote
from synpick_warp.stages.sim.physics import make_pipeline, make_solver, may_capture
from synpick_warp.system.hardware.cores import count_cores
from tools.bench.compare.piles import Pile, build_piles

WARM_STEPS = 2
"""Steps before the first measurement."""
GRAPH_STEPS = 10
"""Steps in a captured graph."""
CONES = {"pyramidal": 10, "elliptic": 20}
"""MuJoCo's friction cones -> maximum iterations of its solver (Newton's method, not the library Newton)."""
CONTACT_ROOM, MIN_CONTACTS = 2.0, 64
"""Contact capacity of a world in MuJoCo Warp: this multiple of the largest count at the ends of our runs, and the minimum."""
CONTACT_ROWS = 4
"""Constraint rows of a contact in the pyramidal cone; the elliptic one has three."""
CAPACITY_STEP = 16
"""Capacities are multiples of this."""
WORLDS_PER_THREAD = 4
"""Worlds of each thread of MuJoCo."""
LINEAR = slice(0, 3)
"""First three components: position of a pose, linear part of a velocity (Newton's bodies, MuJoCo's free joints)."""


class Engine(Protocol):
    """Protocol of a physics engine with a pile in each of its worlds."""

    name: str
    worlds: int

    def start(self, pile: Pile) -> None:
        """Put all worlds into the pile's state, at rest."""

    def run(self, steps: int) -> float:
        """Advance by time steps of `physics.step`; returns the time that it took [s]."""
        ...

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and linear velocities [m/s], each (world, body, 3)."""
        ...


class NewtonEngine:
    """Engine behind Newton's solver interface. Its steps are captured as a graph, where a bake captures them."""

    def __init__(
        self,
        name: str,
        physics: Physics,
        tote: Tote,
        pile: Pile,
        worlds: int,
        device: wp.Device,
        make: Callable[[newton.Model], newton.solvers.SolverBase],
        substeps: int = 1,
    ) -> None:
        """Build the model, and the solver by `make`; `substeps` solver steps, each after a collision detection, are a time step."""
        self.name, self.worlds, self.device = name, worlds, device
        self.model = build_piles(physics, tote, pile, worlds, device)
        self.pipeline = make_pipeline(physics, self.model)
        self.contacts = self.pipeline.contacts()
        self.solver = make(self.model)
        self.state: Any = self.model.state()
        self._other, self.control = self.model.state(), self.model.control()
        self.substeps, self.dt = substeps, physics.step / substeps
        self.peak_contacts = 0
        self._graph: wp.Graph | None = None
        # The first steps run eagerly: they load kernels and trigger late allocations.
        self.start(pile)
        self._advance(WARM_STEPS)
        if may_capture(device):
            with wp.ScopedCapture(device=device) as capture:
                self._advance(GRAPH_STEPS)
            self._graph = capture.graph

    def start(self, pile: Pile) -> None:
        """Set all worlds to the poses of a pile, at rest."""
        pose = np.tile(pile.pose.astype(np.float32).reshape(-1), self.worlds)
        assert self.model.joint_q is not None  # Models with rigid bodies have it.
        for values in (self.model.joint_q, self.state.joint_q):
            values.assign(pose)
        self.state.joint_qd.zero_()
        self.solver.reset(self.state)
        self.pipeline.reset_contact_matching()
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def run(self, steps: int) -> float:
        """Simulate this many steps of all worlds; returns the time taken [s]."""
        wp.synchronize_device(self.device)
        started = time.perf_counter()
        if self._graph is not None:
            for _ in range(steps // GRAPH_STEPS):
                wp.capture_launch(self._graph)
            steps %= GRAPH_STEPS
        self._advance(steps)
        wp.synchronize_device(self.device)
        seconds = time.perf_counter() - started
        contacts = int(self.contacts.rigid_contact_count.numpy()[0])
        self.peak_contacts = max(self.peak_contacts, -(-contacts // self.worlds))
        return seconds

    def _advance(self, steps: int) -> None:
        """Launch steps, each of `substeps` collisions and solves; the result is in `state`."""
        current, following = self.state, self._other
        for _ in range(steps * self.substeps):
            self.pipeline.collide(current, self.contacts)
            self.solver.step(current, following, self.control, self.contacts, self.dt)
            current, following = following, current
        if current is not self.state:
            self.state.assign(current)

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and linear velocities [m/s] of all bodies (world, body, 3)."""
        pose, velocity = (array.numpy().reshape(self.worlds, -1, size) for array, size in ((self.state.body_q, 7), (self.state.body_qd, 6)))
        return pose[..., LINEAR], velocity[..., LINEAR]


def make_ours(physics: Physics, tote: Tote, pile: Pile, worlds: int, device: wp.Device) -> NewtonEngine:
    """Engine with our solver, and the settings of a bake."""
    name = f"SolverSteel ({physics.substeps} x {physics.iterations} iterations)"
    slots = len(pile.entries)
    return NewtonEngine(name, physics, tote, pile, worlds, device, lambda model: make_solver(physics, model, slots), physics.substeps)


def make_mujoco_warp(
    physics: Physics, tote: Tote, pile: Pile, worlds: int, device: wp.Device, cone: str, peak_contacts: int
) -> NewtonEngine:
    """MuJoCo Warp with the contacts of our collision pipeline; memory for `CONTACT_ROOM` times `peak_contacts` contacts a world."""
    contacts = max(MIN_CONTACTS, -(-int(CONTACT_ROOM * peak_contacts) // CAPACITY_STEP) * CAPACITY_STEP)

    def make(model: newton.Model) -> newton.solvers.SolverBase:
        solver = newton.solvers.SolverMuJoCo(
            model,
            use_mujoco_contacts=False,
            solver="newton",
            cone=cone,
            iterations=CONES[cone],
            nconmax=contacts,
            njmax=CONTACT_ROWS * contacts,
        )
        # Printing from kernels that the limit of iterations is reached would cost more than the solver; lost contacts are still printed.
        limits = importlib.import_module("mujoco_warp").OverflowType
        solver.mjw_model.opt.warn_overflow = limits.ALL & ~(limits.ITERATIONS | limits.LS_ITERATIONS)
        return solver

    name = f"MuJoCo Warp ({cone} cone, {CONES[cone]} iterations)"
    return NewtonEngine(name, physics, tote, pile, worlds, device, make)


class MujocoEngine:
    """MuJoCo's engine in C with its own collision detection: `WORLDS_PER_THREAD` worlds for each of the process's CPU cores."""

    def __init__(self, physics: Physics, tote: Tote, pile: Pile, cone: str) -> None:
        self.mujoco, self.rollout = importlib.import_module("mujoco"), importlib.import_module("mujoco.rollout")
        self.physics, self.tote, self.cone = physics, tote, cone
        self.threads = count_cores()
        self.worlds = WORLDS_PER_THREAD * self.threads
        self.name = f"MuJoCo ({cone} cone, {CONES[cone]} iterations, {self.threads} threads)"
        self.state = np.zeros((self.worlds, 0))
        self.start(pile)

    def start(self, pile: Pile) -> None:
        """Build MuJoCo's model of a pile, and set all worlds to its poses, at rest."""
        model = build_piles(self.physics, self.tote, pile, 1, wp.get_device("cpu"))
        # A single contact for two hulls, MuJoCo's default, lets a pile sink 15 mm into the floor.
        solver = newton.solvers.SolverMuJoCo(
            model, use_mujoco_cpu=True, enable_multiccd=True, solver="newton", cone=self.cone, iterations=CONES[self.cone]
        )
        self.model, data = solver.mj_model, solver.mj_data
        self.model.opt.timestep = self.physics.step
        state = np.zeros(self.mujoco.mj_stateSize(self.model, self._spec))
        self.mujoco.mj_getState(self.model, data, state, self._spec)
        self.state = np.tile(state, (self.worlds, 1))
        self.data = [self.mujoco.MjData(self.model) for _ in range(self.threads)]

    @property
    def _spec(self) -> int:
        """MuJoCo's code of the full physics state."""
        return int(self.mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def run(self, steps: int) -> float:
        """Simulate this many steps of all worlds in threads; returns the time taken [s]."""
        started = time.perf_counter()
        states, _ = self.rollout.rollout(self.model, self.data, self.state, nstep=steps)
        seconds = time.perf_counter() - started
        self.state = states[:, -1].copy()
        return seconds

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and linear velocities [m/s] of all bodies (world, body, 3)."""
        positions, end = 1 + self.model.nq, 1 + self.model.nq + self.model.nv
        coordinates, velocities = self.state[:, 1:positions], self.state[:, positions:end]
        return coordinates.reshape(self.worlds, -1, 7)[..., LINEAR], velocities.reshape(self.worlds, -1, 6)[..., LINEAR]
