"""Random sequences of resets, steps, checkpoints and branches of a vector environment, against results by history of actions.

Whatever environment it is in, and whatever happened before and beside it: the same pile and the same actions give the same bits.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from synpick_warp.environment.episodes import Episodes
from synpick_warp.environment.picking import EnvironmentState, PickingEnvironment
from synpick_warp.newton_patches.history import History
from synpick_warp.stages.sim.simulate import Simulation
from tests.environment.conftest import build
from tests.harness.hostile import fuzz_examples

COUNT = 3
"""Environments."""
TWISTS = np.array([[0, 0, -1, 0, 0, 1], [0.5, -0.5, 0.2, 1, 0.5, -1]], float)
"""Actions, by the number that a history has."""
SEEDS = st.lists(st.one_of(st.none(), st.integers(0, 2)), min_size=COUNT, max_size=COUNT)
SOME = st.sets(st.integers(0, COUNT - 1), min_size=1).map(lambda chosen: np.isin(np.arange(COUNT), list(chosen)))
"""Masks of environments."""


class Track(NamedTuple):
    """Model of an environment."""

    seed: int
    count: int
    """Episodes begun since the seed was set."""
    history: tuple[int, ...]
    """Index of the pile, and the actions since."""
    over: bool = False


class Environments(RuleBasedStateMachine):
    """`environment` is under test."""

    environment: ClassVar[PickingEnvironment]

    def __init__(self) -> None:
        super().__init__()
        self.tracks = [Track(index, 0, ()) for index in range(COUNT)]
        self.seen: dict[tuple, Any] = {}
        """What each history gave."""
        self.saved: list[tuple[EnvironmentState, list[Track]]] = []

    def _same(self, kind: str, history: tuple, found: Any) -> None:
        assert self.seen.setdefault((kind, *history), found) == found, f"{kind} of {history} differs"

    def _look(self, obs: dict[str, np.ndarray]) -> None:
        """An observation shows each environment after its history, and so do its counters."""
        episodes = self.environment.episodes
        for index, track in enumerate(self.tracks):
            counters = episodes.seed[index], episodes.count[index], episodes.steps[index], episodes.over[index]
            assert counters == (track.seed, track.count, len(track.history) - 1, track.over)
            self._same("observation", track.history, b"".join(obs[name][index].tobytes() for name in obs))

    def _begin(self, index: int, info: dict[str, np.ndarray], seed: int | None = None) -> None:
        """An episode begins in an environment, the next of its seed."""
        track = self.tracks[index] if seed is None else Track(seed, 0, ())
        pile = int(info["episode_index"][index])
        self._same("pile", (track.seed, track.count), pile)
        self.tracks[index] = Track(track.seed, track.count + 1, (pile,))

    @initialize()
    def start(self):
        self.reset([0, 1, 2], np.ones(COUNT, bool))
        self.save(False)

    @rule(seeds=SEEDS, mask=SOME)
    def reset(self, seeds, mask):
        obs, info = self.environment.reset(seed=seeds, options={"reset_mask": mask})
        for index in np.flatnonzero(mask):
            self._begin(index, info, seeds[index])
        self._look(obs)

    @rule(rounds=st.lists(st.tuples(*[st.integers(0, len(TWISTS) - 1)] * COUNT), min_size=1, max_size=3))
    def step(self, rounds):
        for actions in rounds:
            step = self.environment.step(TWISTS[list(actions)])
            for index, (track, action) in enumerate(zip(self.tracks, actions, strict=True)):
                if track.over:
                    self._begin(index, step.info)
                    continue
                history = (*track.history, action)
                values = step.reward, step.terminated, step.truncated, step.info["outcome"], step.info["steps"]
                result = [value[index].item() for value in values]
                self._same("result", history, result)
                self.tracks[index] = track._replace(history=history, over=result[1] or result[2])
            self._look(step.obs)

    @rule(through_host=st.booleans())
    def save(self, through_host):
        state = self.environment.get_state()
        if through_host:
            state = self.environment.state_from_host(self.environment.state_to_host(state))
        self.saved.append((state, list(self.tracks)))

    @rule(data=st.data(), mask=SOME)
    def restore(self, data, mask):
        state, tracks = data.draw(st.sampled_from(self.saved))
        obs = self.environment.set_state(state, mask)
        self.tracks = [before if chosen else track for before, track, chosen in zip(tracks, self.tracks, mask, strict=True)]
        self._look(obs)

    @rule(origin=st.integers(0, COUNT - 1), into=SOME)
    def branch(self, origin, into):
        obs = self.environment.branch(origin, np.flatnonzero(into).tolist())
        self.tracks = [self.tracks[origin] if chosen else track for track, chosen in zip(self.tracks, into, strict=True)]
        self._look(obs)


@pytest.fixture(scope="module")
def machine(device) -> type[Environments]:
    """The machine, with an environment of few piles and short episodes, whose wrist and objects move in each tick."""
    Environments.environment = build(device, num_envs=COUNT, action="twist", obs=("state", "depth"), max_steps=5, piles=3)
    return Environments


def run(machine: type[Environments], examples: int, **given: Any) -> None:
    run_state_machine_as_test(machine, settings=settings(max_examples=examples, stateful_step_count=12, **given))


@pytest.mark.parametrize("examples", [15, pytest.param(30, marks=pytest.mark.slow)])
def test_the_same_history_gives_the_same_bits(machine, examples):
    run(machine, fuzz_examples(examples))


def _set_all(self: PickingEnvironment, state: EnvironmentState, mask: Any = None, real: Any = PickingEnvironment.set_state) -> Any:
    return real(self, state)


def _branch_worlds(self: PickingEnvironment, environment: int, into: list[int]) -> Any:
    self.worlds.simulation.branch(environment, into)
    return self.observe()


BUGS = {
    "a checkpoint shares its counters": lambda patch: patch.setattr(Episodes, "copy", lambda self: self),
    "a checkpoint is loaded into all": lambda patch: patch.setattr(PickingEnvironment, "set_state", _set_all),
    "a branch has its own counters": lambda patch: patch.setattr(PickingEnvironment, "branch", _branch_worlds),
    "a branch reaches its siblings": lambda patch: patch.setattr(
        Simulation, "branch", lambda self, world, into: self.states.branch(world, range(COUNT))
    ),
    "contacts are not in a checkpoint": lambda patch: patch.setattr(History, "load_contacts", lambda *_: None),
}
"""Planted bugs, by name."""


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_found(machine, monkeypatch, bug):
    BUGS[bug](monkeypatch)
    with pytest.raises(AssertionError):
        run(machine, 60, phases=[Phase.generate], report_multiple_bugs=False)
