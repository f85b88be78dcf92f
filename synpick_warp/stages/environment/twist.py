"""Twist control (Cartesian velocity control) of the grippers: a setpoint law that integrates commanded velocities."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.environment import twist as kernels
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.arrays import Plan
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.worlds import AttemptState, WorldState

COLUMNS = 6
"""Columns of a command: linear velocity (3) [m/s], rates of yaw and tilt [rad/s], suction (on above 0)."""


class TwistLaw:
    """Twist control as a `SetpointLaw`, in all modes.

    Attributes:
        command: Velocities of each world (world, column) float32; read in every step.
    """

    def __init__(self, simulation: Simulation, lower: np.ndarray, upper: np.ndarray) -> None:
        """
        Args:
            simulation: The worlds.
            lower, upper: Corners of the box to which setpoints are clamped, each (3) [m].
        """
        self.simulation = simulation
        self.lower, self.upper = wp.vec3(*lower.tolist()), wp.vec3(*upper.tolist())
        self.command = wp.zeros((simulation.layout.worlds, COLUMNS), dtype=wp.float32, device=simulation.device)

    def begin(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics) -> None:
        """Do nothing: `start_tick` begins attempts."""

    def start_tick(self) -> None:
        """Begin attempts, and apply the commands of the next tick to yaw, tilt and suction. Runs before the tick."""
        simulation = self.simulation
        state, attempts, plan, physics = simulation.state, simulation.attempts, simulation.plan, simulation.physics
        sources = (simulation.scene, state, attempts, plan)
        launch(kernels.start_twists_kernel, len(state.phase), *sources, physics.state)
        given: dict[str, Any] = {"command": self.command, "tick_time": simulation.config.physics.tick_time}
        given |= {"tilt_target": physics.control.joint_target_q, "attached": simulation.seals.attached}
        launch(kernels.begin_twists_kernel, len(state.phase), *sources, **given)
        physics.set_yaw(plan.yaw)

    def advance(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """Integrate the setpoints over a step of physics."""
        given = {"command": self.command, "lower": self.lower, "upper": self.upper}
        launch(kernels.follow_twists_kernel, len(state.phase), scene, state, self.simulation.physics.state, **given)

    def end_tick(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """End attempts whose objects have been lifted to the height at which attempts begin."""
        launch(kernels.end_twists_kernel, len(state.phase), scene, state, attempts, plan, self.simulation.physics.state)
