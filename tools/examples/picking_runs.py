"""Closed-loop evaluation of pickers in simulation: first choices from the same piles, and bin emptying. Needs PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
import warp as wp

from synpick_warp.codes import MAX_INSTANCES, Outcome
from synpick_warp.configs.episodes.manipulation import Pick, Picks, Target
from synpick_warp.environment.picking import PickingEnvironment, Step
from synpick_warp.environment.settings import ATTEMPT, DISABLED, PIXEL, POINT, TARGET, TORCH, Choice, make_choice
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.stages.perception.candidates import CandidateSampler
from tools.examples.picking_scores import Sight

REACH = 4
"""Half side of the square around a failed pick that is barred until another pick succeeds [px]."""
SAMPLED = 256
"""Grasp candidates among which the analytic picker chooses: the sampler draws them over instances and scores, out of 1,024 pixels."""
MASK = "target_mask"
BARRED, MISSED = 1e3, 1e4
"""Penalties on the score of barred pixels, and of pixels beside the target: larger than any score."""
Score = Callable[[Sight], torch.Tensor]
Choose = Callable[[PickingEnvironment, Sight, torch.Tensor | None], torch.Tensor]
"""Picker: environment, what it sees and barred pixels (B, H, W) bool -> pixels (B, 2), or grasps (B, 6) as of action `point`."""


@dataclass
class Emptied:
    """Counts of a bin emptying run: attempts and successes of each bin (bin) int64, emptied bins, and attempts by `Outcome`."""

    attempts: torch.Tensor
    picked: torch.Tensor
    empty: int = 0
    outcomes: torch.Tensor = field(default_factory=lambda: torch.zeros(len(Outcome), dtype=torch.int64))


def choose_environment(task: str, worlds: int, resolution: tuple[int, int], seed: int, max_steps: int | None = None) -> Choice:
    """Options for `make_picking` of a vector environment with whole picks that observes depth and instances."""
    return make_choice(task, worlds, ("depth", "instances"), resolution, PIXEL, DISABLED, TORCH, seed, max_steps, None, ATTEMPT)


def observe(environment: PickingEnvironment, obs: Mapping[str, torch.Tensor]) -> Sight:
    """Convert an observation of the environment to that of pickers."""
    config = environment.worlds.simulation.config
    camera = make_cameras(config.rig)[config.rig.index(config.perception.camera)]
    instance = obs["instances"]
    shown = torch.where(instance <= MAX_INSTANCES, instance, torch.zeros_like(instance))
    target = obs[MASK] > 0 if MASK in obs else None
    return Sight(obs["depth"].clone(), shown, float(camera.matrix[0, 0]) * obs["depth"].shape[2] / camera.width, target)


def choose_pixels(value: torch.Tensor) -> torch.Tensor:
    """Argmax of each image (B, H, W): column and row (B, 2) int64."""
    place = value.flatten(1).argmax(dim=1)
    return torch.stack((place % value.shape[2], place // value.shape[2]), dim=1)


class DenseChoice:
    """Picker by a score map: the pixel with the largest score, on the target if there is one, that is not barred."""

    def __init__(self, score: Score) -> None:
        """Take the score function."""
        self.score = score

    def __call__(self, environment: PickingEnvironment, sight: Sight, barred: torch.Tensor | None) -> torch.Tensor:
        """Choose pixels (B, 2)."""
        value = self.score(sight).double()  # float32 has too few digits beside the penalties.
        if sight.target is not None:
            value = torch.where(sight.target, value, value - MISSED)
        return choose_pixels(value if barred is None else torch.where(barred, value - BARRED, value))


def choose_planned(environment: PickingEnvironment, sight: Sight, barred: torch.Tensor | None) -> torch.Tensor:
    """Choose the grasps (B, 6) that the paper's heuristic has planned; the environment perceives (`make_picking`)."""
    plan = environment.worlds.simulation.plan
    return torch.cat([wp.to_torch(part)[: environment.count] for part in (plan.point, plan.normal)], dim=1).clone()


class AnalyticChoice:
    """Picker by SuctionNet's analytic map: of grasp candidates of each state the one with the largest seal score x wrench score."""

    def __init__(self, environment: PickingEnvironment) -> None:
        """Allocate a sampler of candidates."""
        self.sampler = CandidateSampler(environment.worlds.simulation, Picks(candidates=SAMPLED, uniform=0.0))

    def __call__(self, environment: PickingEnvironment, sight: Sight, barred: torch.Tensor | None) -> torch.Tensor:
        """Choose grasps (B, 6)."""
        count, target = environment.count, wp.to_torch(environment.worlds.simulation.plan.target).clone()
        state = environment.get_state()
        grasps, candidates, _ = self.sampler.sample(state.worlds, range(count))
        environment.set_state(state)
        score = (wp.to_torch(candidates.seal) * wp.to_torch(candidates.wrench)).view(count, -1)
        score[:, 0] = -1.0  # The heuristic's own grasp.
        if sight.target is not None:
            score = torch.where(wp.to_torch(grasps.target).view(count, -1) == target[:count, None], score, -2.0)
        best = score.argmax(dim=1) + torch.arange(count, device=score.device) * SAMPLED
        return torch.cat([wp.to_torch(part)[best] for part in (grasps.point, grasps.normal)], dim=1)


def act(environment: PickingEnvironment, actions: torch.Tensor) -> Step:
    """Carry out picks at pixels (B, 2), or grasps (B, 6). Bounds of actions do not apply: plans may be beyond the rim."""
    choice, bounds = environment.choice, environment.bounds
    environment.choice = replace(choice, action=PIXEL if actions.shape[1] == 2 else POINT)
    environment.bounds = np.full(3, -np.inf), np.full(3, np.inf)
    try:
        return environment.step(actions)
    finally:
        environment.choice, environment.bounds = choice, bounds


def run_first_choices(
    environment: PickingEnvironment, pickers: Mapping[str, Choose], attempts: int
) -> Iterator[tuple[dict[str, tuple[int, torch.Tensor]], int]]:
    """Paired comparison: each picker makes its first choice from the same piles, of which at least `attempts` are drawn.

    Yields, after each draw, what there is so far: successes of each picker with its counts by `Outcome`, and the number of piles.
    """
    results, piles = {name: (0, torch.zeros(len(Outcome), dtype=torch.int64)) for name in pickers}, 0
    while piles < attempts:
        environment.reset()
        start = environment.get_state()
        for name, choose in pickers.items():
            step = act(environment, choose(environment, observe(environment, environment.set_state(start)), None))
            picked, outcomes = results[name]
            results[name] = picked + int(step.reward.sum()), outcomes + _count(step)
        environment.set_state(start)
        piles += environment.count
        yield results, piles


def _count(step: Step, counted: torch.Tensor | None = None) -> torch.Tensor:
    """Attempts of a step by `Outcome`, on the host; `counted` (environment) bool: of these alone."""
    outcome = step.info["outcome"].long()
    return torch.bincount(outcome if counted is None else outcome[counted], minlength=len(Outcome)).cpu()


def run_until_empty(environment: PickingEnvironment, choose: Choose, failures: int = Pick().failures) -> Emptied:
    """Bin emptying: pick in all environments until their episodes end; squares around failed picks are barred.

    As in the paper, an episode also ends after `failures` attempts that catch nothing; with a target they are counted anew after a catch.
    """
    sight = observe(environment, environment.reset()[0])
    failed = torch.zeros(environment.count, dtype=torch.int64, device=sight.depth.device)
    result = Emptied(failed.clone(), failed.clone())
    barred = torch.zeros_like(sight.depth, dtype=torch.bool)
    over, forgives = failed > 0, environment.choice.task == TARGET and Target().forgive
    while not bool(over.all()):
        actions = choose(environment, sight, barred)
        step = act(environment, actions)
        caught = (step.info["outcome"] == Outcome.TARGET_PICKED) | (step.info["outcome"] == Outcome.OTHER_PICKED)
        result.outcomes += _count(step, ~over)
        result.attempts += ~over
        result.picked += (step.reward > 0) & ~over
        result.empty += int((step.terminated & ~over).sum())
        barred[caught] = False
        failed = torch.where(caught, failed * (not forgives), failed + 1)
        if actions.shape[1] == 2:
            for index in torch.nonzero(~caught & ~over)[:, 0].tolist():
                column, row = actions[index].tolist()
                barred[index, max(0, row - REACH) : row + REACH + 1, max(0, column - REACH) : column + REACH + 1] = True
        over |= step.terminated | step.truncated | (failed >= failures)
        sight = observe(environment, step.obs)
    return result
