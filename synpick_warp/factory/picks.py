"""Grasp trials of a bake: a batch queue of saved states, an engine that runs their trials, and the tables for exporters.

The engine has a second simulation of the same objects, while the first one continues with the episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from synpick_warp.codes import Outcome
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.episodes.manipulation import Picks
from synpick_warp.stages.perception.candidates import CandidateSampler
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State
from synpick_warp.stages.sim.trials import BATCH_ROUNDS, Choice, ChoiceReader, ChoiceRecorder, Trials, count_trial_worlds, trial_values
from synpick_warp.stages.stream import TickReport
from synpick_warp.stages.timing import scope
from synpick_warp.views.picks import PickBatch

if TYPE_CHECKING:
    from synpick_warp.factory.assembly import Stages

MAX_LEAD = 1
"""Maximum number of ticks by which physics may run ahead of the host; the ring buffer of states has room for them."""


class PickEngine:
    """Samples grasp candidates of saved states and runs their trials, in a simulation of its own."""

    def __init__(self, stages: Stages) -> None:
        """Build a simulation with the objects, settings and meshes of `stages`, and the settings of `trial_values`."""
        config, self.device = stages.config, stages.simulation.device
        worlds = count_trial_worlds(config.picks, DataLayout.of(config).planned, self.device)
        self.config, self.object_ids = config.with_values(trial_values(config.picks, worlds)), stages.catalog.object_ids
        scene, lights = stages.groups[0].renderer.scene, len(stages.lights)
        self.simulation = Simulation(self.config, stages.catalog, lights, self.device, scene, episodes=[])
        self.simulation.tick()
        self.sampler = CandidateSampler(self.simulation, config.picks)
        self.trials = Trials(self.simulation, config.picks)

    @property
    def trials_of_state(self) -> int:
        """Number of trials of a state."""
        return self.config.picks.candidates * self.config.picks.repeats

    def run(self, states: State, choices: Sequence[Choice]) -> list[PickBatch]:
        """Run the trials of the rows `choices` of saved states; returns a `PickBatch` per episode. Waits for the device."""
        with scope("sample candidates", self.device):
            grasps, candidates, visible = self.sampler.sample(states, [choice.row for choice in choices])
        with scope("run trials", self.device):
            labels = self.trials.run(states, grasps)
        each = self._trial_columns(choices, grasps, candidates, labels)
        return list(self._split(choices, each, visible))

    def _trial_columns(
        self, choices: Sequence[Choice], grasps: Any, candidates: Any, labels: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Columns of `views.picks.COLUMNS` (trial[, 3]), by state, candidate and repeat, in the order of `choices`."""
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
        """Group trials and visible instances (choice, instance) into a `PickBatch` per episode, by state; without states that show none."""
        width, height = self.config.perception.resolution
        camera = self.config.rig.index(self.config.perception.camera)
        order = sorted(np.flatnonzero(visible.any(axis=1)).tolist(), key=lambda index: (choices[index].episode, choices[index].state))
        for episode, group in groupby(order, key=lambda index: choices[index].episode):
            rows = np.array(list(group))
            mine = (rows[:, None] * self.trials_of_state + np.arange(self.trials_of_state)).ravel()
            states = {name: np.array([getattr(choices[row], name) for row in rows]) for name in ("state", "frame")}
            sizes = {"camera": camera, "width": width, "height": height, "candidates": self.config.picks.candidates}
            states |= {name: np.full(len(rows), value) for name, value in sizes.items()}
            yield PickBatch(episode, {name: values[mine] for name, values in trials.items()}, states | {"visible": visible[rows]})


class PickQueue:
    """Batch queue of saved states that await their trials; defers the end of an episode until no state of it waits."""

    def __init__(self, simulation: Simulation, engine: PickEngine, labelled: int) -> None:
        """Save states of the simulation from its next tick on; `labelled`: number of catalog objects with labels.

        Attribute `lead`: maximum number of ticks by which physics may run ahead of `take`.
        """
        self.engine = engine
        worlds = simulation.layout.worlds
        self.batch = count_batch(engine.config.picks, DataLayout.of(engine.config).planned, engine.simulation.layout.worlds)
        self.recorder = ChoiceRecorder(simulation, engine.config.picks.states, count_rows(self.batch, worlds))
        self.reader = ChoiceReader(self.recorder, labelled)
        self.lead = MAX_LEAD if simulation.device.is_cuda else 0
        self.pending: list[Choice] = []
        self._ends: list[tuple[int, Callable[[], None]]] = []

    def take(self, report: TickReport) -> None:
        """Enqueue the states that a tick has saved."""
        self.pending += self.reader.read(report)

    def drop(self, episode: int, arrangement: int) -> None:
        """Remove the waiting states of an arrangement that is not delivered."""
        self.pending = [choice for choice in self.pending if (choice.episode, choice.arrangement) != (episode, arrangement)]

    def end(self, episode: int, then: Callable[[], None]) -> None:
        """Call `then` once no state of an episode waits: now, or in a later `release`."""
        self._ends.append((episode, then))
        self.release()

    @property
    def is_due(self) -> bool:
        """Whether a whole batch of states waits."""
        return len(self.pending) >= self.batch

    def run(self) -> list[PickBatch]:
        """Run the trials of all waiting states. Call `release` after the exporters have received the batches."""
        choices, self.pending = self.pending, []
        return self.engine.run(self.recorder.ring, choices) if choices else []

    def release(self) -> None:
        """Call the deferred ends of episodes of which no state waits."""
        waiting = {choice.episode for choice in self.pending}
        ready = [then for episode, then in self._ends if episode not in waiting]
        self._ends = [(episode, then) for episode, then in self._ends if episode in waiting]
        for then in ready:
            then()


def count_batch(picks: Picks, episodes: int, worlds: int) -> int:
    """Number of states of a batch: BATCH_ROUNDS trials in each of the trial worlds, rounded up, but not more than `episodes` may have."""
    return max(1, min(-(-BATCH_ROUNDS * worlds // (picks.candidates * picks.repeats)), episodes * picks.states))


def count_rows(batch: int, worlds: int) -> int:
    """Rows of the ring buffer: a batch, plus one state per world for the tick that fills it, each tick of lead, and a tick in progress."""
    return batch + (MAX_LEAD + 2) * worlds
