"""Train a suction picker (pixel-wise success prediction by a U-Net) on simulated picks; score it on tried candidates and in simulation.

The network predicts the logit of success at each pixel of camera 0's depth image; it learns from tried pixels, and from pixels without
object as failures. Needs PyTorch; the defaults are for a GPU.

    synpick-warp bake --config synpick --episodes 300 --formats shards,picks --set cameras.resolution=[320,180] --out DATA
    python -m tools.examples.train_picker train DATA --picker picker.pt
    python -m tools.examples.train_picker run --picker picker.pt --config synpick --worlds 512 --attempts 1000
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch  # pyright: ignore[reportMissingImports]
except ModuleNotFoundError as missing:
    raise SystemExit(f"train_picker: {missing.name} is not installed; pip install torch") from None

from synpick_warp.apps.statistics.ranking import Interval, Scored, estimate, weighted_auc
from synpick_warp.codes import Outcome
from synpick_warp.environment.settings import PICK, TARGET
from synpick_warp.errors import ConfigError, DatasetError, SynpickError
from synpick_warp.system.hardware.device import pick_device
from tools.examples.picking_data import Samples, load_samples
from tools.examples.picking_network import load_picker, save_picker, score_learned, train
from tools.examples.picking_scores import Sight, score_contour_distance, score_flatness, score_random, wilson
from tools.options import configure, fail, make_names_parser, make_parser, positive_count, write_json

HELD_OUT = 5
"""Stride of the train/test split: every fifth episode is held out from training."""
FEW_DRAWS = 200
"""Bootstrap resamples of statistics over all trials."""
CHUNK = 64
"""Images that are scored at a time."""
RANDOM, CONTOUR, FLATNESS, LEARNED = "random", "contour", "flatness", "learned"
ANALYTIC, OWN = "analytic", "heuristic"
PICKERS = (LEARNED, OWN, ANALYTIC, CONTOUR, FLATNESS, RANDOM)
LONGEST = 100
"""Attempts after which a bin counts as not emptied: three for each of most objects."""
Score = Callable[[Sight], torch.Tensor]


def dense_scores(network: torch.nn.Module, device: torch.device) -> dict[str, Score]:
    """Score functions by picker name: the learned picker, and the baselines."""
    generator = torch.Generator(device).manual_seed(0)
    learned, drawn = partial(score_learned, network), partial(score_random, generator=generator)
    return {LEARNED: learned, CONTOUR: score_contour_distance, FLATNESS: score_flatness, RANDOM: drawn}


def evaluate(samples: Samples, scores: dict[str, Score], device: torch.device) -> dict[str, dict[str, Interval]]:
    """Evaluate pickers at tried pixels: AUC over trials, with inverse probability weights, and the success rate of the first choice, the
    candidate with the largest score; each with its interval by cluster bootstrap over states."""
    trials, count = samples.trials, len(samples.episode)
    at = (trials["state"], trials["y"], trials["x"])
    chunks = [samples.sight.part(slice(first, first + CHUNK)).to(device) for first in range(0, count, CHUNK)]
    values = {name: torch.cat([score(chunk).cpu() for chunk in chunks]).numpy()[at] for name, score in scores.items()}
    values[ANALYTIC] = trials["seal"] * trials["wrench"]
    success, weight = trials["success"].astype(bool), trials["weight"].astype(float)
    _, which = np.unique(np.stack((trials["state"], trials["candidate"])), axis=1, return_inverse=True)
    rates = (np.bincount(which.ravel(), success) / np.bincount(which.ravel()))[which.ravel()]
    states = np.split(np.arange(len(success)), np.flatnonzero(np.diff(trials["state"])) + 1)
    figures = {}
    for name, value in values.items():
        firsts = np.array([rates[rows[value[rows] == value[rows].max()]].mean() for rows in states])
        chosen = Scored(firsts, np.zeros(len(firsts), bool), np.ones(len(firsts)), np.arange(len(firsts)))
        figures[name] = {
            "auc": estimate(Scored(value, success, weight, trials["state"]), weighted_auc, FEW_DRAWS),
            "first": estimate(chosen, lambda scored, weight: float(weight @ scored.score / weight.sum())),
        }
    return figures


def run_train(options: argparse.Namespace, device: torch.device) -> None:
    """Command `train`: train on all episodes except those held out, and evaluate on these."""
    if not options.picker.parent.is_dir():
        raise ConfigError(f"--picker is {options.picker}; name a file in a folder that exists")
    samples = load_samples(options.folder)
    held = np.isin(samples.episode, np.unique(samples.episode)[HELD_OUT - 1 :: HELD_OUT])
    if not held.any() or held.all():
        raise DatasetError(f"{options.folder} has picks of {len(np.unique(samples.episode))} episodes; needed: at least {HELD_OUT}")
    used, trials, started = np.flatnonzero(~held), len(samples.trials["state"]), time.perf_counter()
    print(f"{len(used)} states to train on, {held.sum()} held out, {trials:,} trials")
    network, losses = train(samples.part(used), options.width, options.steps, device, options.seed, options.batch)
    loss, seconds = float(np.mean(losses[-len(losses) // 10 :])), time.perf_counter() - started
    print(f"{len(losses)} steps in {seconds:.1f} s: loss {losses[0]:.3f} to {loss:.3f}")
    height, width = samples.sight.depth.shape[1:]
    save_picker(options.picker, network, options.width, (width, height))
    figures = evaluate(samples.part(np.flatnonzero(held)), dense_scores(network, device), device)
    for name, values in figures.items():
        print(f"{name:10}", *(f"{key} {value.value:.3f} ({value.low:.3f} to {value.high:.3f})" for key, value in values.items()))
    rows = {name: {key: vars(value) for key, value in values.items()} for name, values in figures.items()}
    write_json(options.json, {"states": len(used), "held_out": int(held.sum()), "trials": trials, "train_s": seconds, "rows": rows})


def run_simulation(options: argparse.Namespace, device: torch.device) -> None:
    """Command `run`: success rate of each picker's first choice from the same piles, and optionally of bin emptying."""
    from synpick_warp.environment.make import make_picking
    from tools.examples import picking_runs as runs

    network, parts = load_picker(options.picker, device)
    choice = runs.choose_environment(options.task, options.worlds, tuple(parts["size"]), options.seed, LONGEST)
    environment = make_picking(choice, configure(options, {}), perceives=True)
    pickers = {name: runs.DenseChoice(score) for name, score in dense_scores(network, device).items()}
    pickers |= {OWN: runs.choose_planned, ANALYTIC: runs.AnalyticChoice(environment)}
    chosen = {name: pickers[name] for name in options.pickers}
    facts, started = {"task": options.task, "seed": options.seed}, time.perf_counter()
    results: list[dict[str, Any]] = []
    for found, piles in runs.run_first_choices(environment, chosen, options.attempts):
        print(f"first choice, task {options.task}, {piles} piles, in {time.perf_counter() - started:.0f} s")
        results = [
            show_rate({"picker": name, "run": "first choice"}, torch.tensor(count), outcomes) for name, (count, outcomes) in found.items()
        ]
        write_json(options.json, facts | {"rows": results})
    for name in chosen if options.until_empty else ():
        started = time.perf_counter()
        total = runs.run_until_empty(environment, chosen[name])
        print(f"until empty: {total.empty} of {environment.count} bins emptied in {time.perf_counter() - started:.0f} s")
        emptied = {"picker": name, "run": "until empty", "bins": environment.count, "emptied": total.empty}
        results.append(show_rate(emptied, total.picked, total.outcomes, total.attempts))
        write_json(options.json, facts | {"rows": results})
        environment.episodes.count[:] -= 1  # The next picker gets the same piles.


def show_rate(facts: dict[str, Any], picked: torch.Tensor, outcomes: torch.Tensor, attempts: torch.Tensor | None = None) -> dict[str, Any]:
    """Print the success rate of a run with its 95 % interval and outcomes, and return them with `facts` for JSON.

    `picked` counts the successes, of each bin if `attempts` (bin) has theirs. Wilson's interval takes attempts as independent, as first
    choices are; attempts from one bin depend on each other, so the interval then also covers that of a cluster bootstrap over bins.
    """
    count, total = int(outcomes.sum()), int(picked.sum())
    low, high = wilson(total, count)
    if attempts is not None:
        hits, tries = picked.cpu().numpy().astype(float), attempts.cpu().numpy().astype(float)
        bins = Scored(hits, np.zeros(len(hits), bool), np.ones(len(hits)), np.arange(len(hits)))
        clustered = estimate(bins, lambda _, weight: float(weight @ hits / (weight @ tries)))
        low, high = min(low, clustered.low), max(high, clustered.high)
        facts = {**facts, "bin_attempts": attempts.tolist(), "bin_picked": picked.tolist()}
    named = {outcome.name.lower(): int(number) for outcome, number in zip(Outcome, outcomes, strict=True) if number}
    print(f"  {facts['picker']:10} {total / max(count, 1):.4f} ({low:.4f} to {high:.4f}) of {count}: {named}")
    return {**facts, "attempts": count, "picked": total, "low": low, "high": high, "outcomes": named}


COMMANDS = {"train": run_train, "run": run_simulation}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = parse(arguments)
    try:
        COMMANDS[options.command](options, torch.device(pick_device(options.device).alias))
    except SynpickError as error:
        return fail("train_picker", error)
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser(__doc__, "config", "device", "models", "lights", "seed", "set", "json")
    parser.add_argument("command", choices=COMMANDS, help="train and score on held-out episodes; run in simulation")
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="data set with picks and images (train)")
    parser.add_argument("--picker", type=Path, default=Path("picker.pt"), metavar="FILE", help="file of the network (default: picker.pt)")
    parser.add_argument("--width", type=positive_count, default=24, help="channels of the network's first level (default: 24)")
    parser.add_argument("--steps", type=positive_count, default=4000, help="steps of training (default: 4000)")
    parser.add_argument("--batch", type=positive_count, default=16, help="images of a step (default: 16)")
    parser.add_argument("--worlds", type=positive_count, default=512, help="piles at a time (run; default: 512)")
    parser.add_argument("--task", choices=(PICK, TARGET), default=PICK, help="pick any object, or the most occluded one (run)")
    names = make_names_parser(PICKERS, "picker")
    parser.add_argument("--pickers", type=names, default=PICKERS, help=f"those to run, separated by commas (default: {','.join(PICKERS)})")
    parser.add_argument("--attempts", type=int, default=1000, help="least number of first choices, 0: none (run; default: 1000)")
    parser.add_argument("--until-empty", action="store_true", help="also pick until the bins are empty (run)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
