"""Moments of choice: saves the states of episodes in a ring on the device, in which grasps will be tried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.sim.choices import list_choices_kernel
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State
from synpick_warp.stages.stream import TickReport


@dataclass(frozen=True)
class Choice:
    """Saved moment of choice: row of the ring, episode and arrangement, index among the episode's states, frame."""

    row: int
    episode: int
    arrangement: int
    state: int
    frame: int


class ChoiceRecorder:
    """Saves the states of worlds that have planned an attempt, at the end of each tick of a simulation.

    The host is not told which: it works the same rule out from the reports of the ticks (`ChoiceReader`).

    Attributes:
        states: At most so many states of an episode.
        rows: Rows of the ring; a row is overwritten after so many states.
    """

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
        """The saved states; they can be allocated after the first tick."""
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
    """Finds in the reports of ticks, of which none may be left out, what a `ChoiceRecorder` has saved."""

    def __init__(self, recorder: ChoiceRecorder, labelled: int) -> None:
        """`labelled`: objects of the catalog that have labels."""
        self.states, self.rows, self.labelled = recorder.states, recorder.rows, labelled
        self._strides = np.ones(recorder.simulation.layout.worlds, int)
        self._next = 0

    def read(self, report: TickReport) -> list[Choice]:
        """Choices of a tick, in order of their rows."""
        looks = (report.column("phase") == Phase.ACT) & (report.column("task") == Task.LOOK) & (report.plan.target >= 0)
        found = []
        for world in np.flatnonzero(looks).tolist():
            attempt = int(report.column("attempt")[world]) + 1
            if attempt == 0:
                index = report.catalog_index[world]
                self._strides[world] = max(1, -(-int(((index >= 0) & (index < self.labelled)).sum()) // self.states))
            state, rest = divmod(attempt, int(self._strides[world]))
            if rest == 0 and state < self.states:
                episode, arrangement, frame = (int(report.column(name)[world]) for name in ("episode", "arrangement", "frame"))
                found.append(Choice(self._next % self.rows, episode, arrangement, state, frame))
                self._next += 1
        return found
