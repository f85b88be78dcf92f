"""Closed-loop evaluation of pickers in simulation: first choices from the same piles, and bin emptying. Needs PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch  # pyright: ignore[reportMissingImports]

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.environment.settings import ATTEMPT, DISABLED, PICK, PIXEL, TORCH, Choice, make_choice
from synpick_warp.scenes.cameras import make_cameras
from tools.examples.picking_scores import Sight

REACH = 4
"""Half side of the square around a failed pick that is barred until another pick succeeds [px]."""
Score = Callable[[Sight], torch.Tensor]


@dataclass
class Emptied:
    """Counts of a bin emptying run: attempts, successful ones, bins, and emptied ones."""

    attempts: int = 0
    picked: int = 0
    bins: int = 0
    empty: int = 0


def choose_environment(worlds: int, resolution: tuple[int, int], seed: int, max_steps: int | None = None) -> Choice:
    """Options for `make_picking` of a vector environment with whole picks at pixels that observes depth and instances."""
    return make_choice(PICK, worlds, ("depth", "instances"), resolution, PIXEL, DISABLED, TORCH, seed, max_steps, None, ATTEMPT)


def observe(environment: PickingEnvironment, obs: Mapping[str, torch.Tensor]) -> Sight:
    """Convert an observation of the environment to that of pickers."""
    config = environment.worlds.simulation.config
    camera = make_cameras(config.rig)[config.rig.index(config.perception.camera)]
    instance = obs["instances"]
    shown = torch.where(instance <= MAX_INSTANCES, instance, torch.zeros_like(instance))
    return Sight(obs["depth"].clone(), shown, float(camera.matrix[0, 0]) * obs["depth"].shape[2] / camera.width)


def choose_pixels(value: torch.Tensor) -> torch.Tensor:
    """Argmax of each image (B, H, W): column and row (B, 2) int64."""
    place = value.flatten(1).argmax(dim=1)
    return torch.stack((place % value.shape[2], place // value.shape[2]), dim=1)


def run_first_choices(environment: PickingEnvironment, scores: Mapping[str, Score], attempts: int) -> tuple[dict[str, int], int]:
    """Paired comparison: each picker makes its first choice from the same piles, of which at least `attempts` are drawn.

    Returns:
        Successes of each picker, and the number of piles.
    """
    picked, piles = dict.fromkeys(scores, 0), 0
    while piles < attempts:
        environment.reset()
        start = environment.get_state()
        for name, score in scores.items():
            pixels = choose_pixels(score(observe(environment, environment.set_state(start))))
            picked[name] += int(environment.step(pixels).reward.sum())
        environment.set_state(start)
        piles += environment.count
    return picked, piles


def run_until_empty(environment: PickingEnvironment, score: Score) -> Emptied:
    """Bin emptying: pick in all environments until their episodes end; squares around failed picks are barred."""
    obs, _ = environment.reset()
    result, value = Emptied(bins=environment.count), torch.zeros(0)
    barred = torch.zeros_like(obs["depth"], dtype=torch.bool)
    over = torch.zeros(environment.count, dtype=torch.bool, device=barred.device)
    while not bool(over.all()):
        value = torch.where(barred, -1.0, score(observe(environment, obs)))
        pixels = choose_pixels(value)
        step = environment.step(pixels)
        success = (step.reward > 0) & ~over
        result.attempts += int((~over).sum())
        result.picked += int(success.sum())
        result.empty += int((step.terminated & ~over).sum())
        barred[success] = False
        for index in torch.nonzero(~success & ~over)[:, 0].tolist():
            column, row = pixels[index].tolist()
            barred[index, max(0, row - REACH) : row + REACH + 1, max(0, column - REACH) : column + REACH + 1] = True
        over |= step.terminated | step.truncated
        obs = step.obs
    return result
