"""Grasp trials of a bake: tries candidates in the saved states of its episodes, and hands their tables to the exporters.

A second simulation of the same objects runs the trials, since the first one goes on with its episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Outcome
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.perception.candidates import CandidateSampler
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.choices import Choice, ChoiceReader, ChoiceRecorder
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State
from synpick_warp.stages.sim.trials import ROUNDS, Trials, trial_config
from synpick_warp.stages.stream import TickReport
from synpick_warp.stages.timing import scope
from synpick_warp.views.picks import PickBatch

MAX_LEAD = 1
"""Ticks by which physics may be ahead, so that the ring of states needs room for few."""


class PickEngine:
    """Samples and tries the grasp candidates of saved states, in worlds of its own."""

    def __init__(self, config: Config, catalog: Catalog, lights: int, device: wp.Device, render_scene: RenderScene) -> None:
        """Build the worlds; arguments as of `Simulation`."""
        self.config = config = trial_config(config, device)
        self.device, self.object_ids = device, catalog.object_ids
        self.simulation = Simulation(config, catalog, lights, device, render_scene, episodes=[])
        self.simulation.tick()
        self.sampler = CandidateSampler(self.simulation, config.picks)
        self.trials = Trials(self.simulation, config.picks)

    @property
    def trials_of_state(self) -> int:
        """Number of trials of a state."""
        return self.config.picks.candidates * self.config.picks.repeats

    def run(self, states: State, choices: Sequence[Choice]) -> list[PickBatch]:
        """Run the trials of saved states, of which `choices` have the rows; returns a batch of each episode. Waits for the device."""
        with scope("sample candidates", self.device):
            grasps, candidates, visible = self.sampler.sample(states, [choice.row for choice in choices])
        with scope("run trials", self.device):
            labels = self.trials.run(states, grasps)
        each = self._trial_columns(choices, grasps, candidates, labels)
        return list(self._split(choices, each, visible))

    def _trial_columns(
        self, choices: Sequence[Choice], grasps: Any, candidates: Any, labels: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Columns of the table of trials, of all states in order."""
        picks, step, count = self.config.picks, self.config.physics.step, self.trials_of_state
        given = {
            name: np.repeat(getattr(part, name).numpy(), picks.repeats, axis=0) for part in (grasps, candidates) for name in part._cls.vars
        }
        outcome, held, hits = labels["outcome"], labels["held"] * step, labels["hits"]
        columns = {name: np.repeat([getattr(choice, name) for choice in choices], count) for name in ("state", "frame")}
        columns |= {name: given[name] for name in ("candidate", "share", "weight", "point", "yaw", "tilt", "seal", "wrench")}
        columns |= {name: labels[name] for name in ("offset", "rotation", "friction", "outcome", "ending", "picked", "peak_force")}
        columns |= {name: labels[name] for name in ("moved", "farthest", "lost")}
        return columns | {
            "repeat": np.tile(np.arange(picks.repeats), len(outcome) // picks.repeats),
            "column": given["pixel"][:, 0],
            "row": given["pixel"][:, 1],
            "instance": given["target"],
            "obj_id": self.object_ids[given["entry"]],
            "normal": given["surface_normal"],
            "approach": -given["normal"],
            "success": np.isin(outcome, (Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)),
            "intended": outcome == Outcome.TARGET_PICKED,
            "hits": hits[:, 0],
            "sealed": hits[:, 1],
            "margin": np.where(held > 0, 1.0 - labels["load"], np.nan),
            "time_to_break": np.where((outcome == Outcome.DROPPED) & (held > 0), held, np.nan),
            "held": held,
            "duration": labels["ticks"] * self.config.physics.tick_time,
        }

    def _split(self, choices: Sequence[Choice], trials: dict[str, np.ndarray], visible: np.ndarray) -> Iterator[PickBatch]:
        """A batch of each episode."""
        width, height = self.config.perception.resolution
        camera = self.config.rig.index(self.config.perception.camera)
        order = sorted(range(len(choices)), key=lambda index: (choices[index].episode, choices[index].state))
        for episode, group in groupby(order, key=lambda index: choices[index].episode):
            rows = np.array(list(group))
            mine = (rows[:, None] * self.trials_of_state + np.arange(self.trials_of_state)).ravel()
            states = {name: np.array([getattr(choices[row], name) for row in rows]) for name in ("state", "frame")}
            sizes = {"camera": camera, "width": width, "height": height, "candidates": self.config.picks.candidates}
            states |= {name: np.full(len(rows), value) for name, value in sizes.items()}
            yield PickBatch(episode, {name: values[mine] for name, values in trials.items()}, states | {"visible": visible[rows]})


class PickQueue:
    """Saved states of a bake's episodes that wait for their trials, and ends of episodes that wait for their states."""

    def __init__(self, simulation: Simulation, engine: PickEngine, labelled: int) -> None:
        """Save states of the simulation from its next tick on; `labelled`: objects of the catalog that have labels.

        `lead`: ticks by which physics may be ahead; the ring of states has room for no more.
        """
        self.engine = engine
        worlds = simulation.layout.worlds
        self.batch = count_batch(engine.simulation.layout.worlds, engine.trials_of_state)
        self.recorder = ChoiceRecorder(simulation, engine.config.picks.states, count_rows(self.batch, worlds))
        self.reader = ChoiceReader(self.recorder, labelled)
        self.lead = MAX_LEAD if simulation.device.is_cuda else 0
        self.pending: list[Choice] = []
        self._ends: list[tuple[int, Callable[[], None]]] = []

    def take(self, report: TickReport) -> None:
        """Note the states that a tick has saved."""
        self.pending += self.reader.read(report)

    def drop(self, episode: int, arrangement: int) -> None:
        """Forget the states of an arrangement that is not delivered."""
        self.pending = [choice for choice in self.pending if (choice.episode, choice.arrangement) != (episode, arrangement)]

    def end(self, episode: int, then: Callable[[], None]) -> None:
        """Call `then` once no state of an episode waits: at once, or in `release`."""
        self._ends.append((episode, then))
        self.release()

    @property
    def is_due(self) -> bool:
        """Whether there are states for a whole batch."""
        return len(self.pending) >= self.batch

    def run(self) -> list[PickBatch]:
        """Run the trials of all states that wait; `release` ends their episodes once the batches are handed over."""
        choices, self.pending = self.pending, []
        return self.engine.run(self.recorder.ring, choices) if choices else []

    def release(self) -> None:
        """End the episodes of which no state waits."""
        waiting = {choice.episode for choice in self.pending}
        ready = [then for episode, then in self._ends if episode not in waiting]
        self._ends = [(episode, then) for episode, then in self._ends if episode in waiting]
        for then in ready:
            then()


def count_batch(worlds: int, trials_of_state: int) -> int:
    """States of a batch, for ROUNDS trials in each of the worlds in which they run."""
    return max(1, -(-ROUNDS * worlds // trials_of_state))


def count_rows(batch: int, worlds: int) -> int:
    """Rows of the ring of states: a batch, what a tick adds beyond it, and what the ticks add that physics is ahead or has begun."""
    return batch + (MAX_LEAD + 2) * worlds
