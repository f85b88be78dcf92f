"""Ring buffer of checkpoints at moments of choice, from which grasps are tried.

A moment of choice is the end of a tick in which an attempt was planned; the attempt begins with the next tick.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.sim.trials import list_choices_kernel
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State
from synpick_warp.stages.stream import TickReport


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
