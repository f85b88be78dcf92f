"""Train a suction picker (pixel-wise success prediction by a U-Net) on simulated picks; score it on tried candidates and in simulation.

The network predicts the logit of success at each pixel of camera 0's depth image; it learns from tried pixels, and from pixels without
object as failures. Needs PyTorch; the defaults are for a GPU.

    synpick-warp bake --config synpick --episodes 300 --formats shards,picks --set cameras.resolution=[320,180] --out DATA
    python -m tools.examples.train_picker train DATA --picker picker.pt --unseen 7
    python -m tools.examples.train_picker evaluate DATA --picker picker.pt
    python -m tools.examples.train_picker run --picker picker.pt --config synpick --worlds 512 --attempts 1000
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
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
from synpick_warp.codes import Outcome, Share
from synpick_warp.environment.settings import PICK, TARGET
from synpick_warp.errors import ConfigError, DatasetError, SynpickError
from synpick_warp.system.hardware.device import pick_device
from tools.examples.picking_data import Samples, load_samples, split_objects
from tools.examples.picking_network import load_picker, save_picker, score_learned, train
from tools.examples.picking_scores import (
    Sight,
    average_precision,
    mean_score,
    score_contour_distance,
    score_flatness,
    score_random,
    wilson,
)
from tools.options import configure, fail, make_names_parser, make_parser, positive_count, write_json

HELD_OUT = 5
"""Stride of the train/test split: every fifth episode is held out from training."""
FEW_DRAWS = 200
"""Bootstrap resamples of statistics over all trials."""
CHUNK = 64
"""Images that are scored at a time."""
MOST_OF_EACH = 2
"""Most instances of an object in piles that are limited to seen or unseen objects."""
RANDOM, CONTOUR, FLATNESS, LEARNED = "random", "contour", "flatness", "learned"
ANALYTIC, OWN, ORACLE = "analytic", "heuristic", "oracle"
PICKERS = (LEARNED, OWN, ANALYTIC, CONTOUR, FLATNESS, RANDOM)
LONGEST = 100
"""Attempts after which a bin counts as not emptied: three for each of most objects."""
Score = Callable[[Sight], torch.Tensor]


def dense_scores(network: torch.nn.Module | None, device: torch.device) -> dict[str, Score]:
    """Score functions by picker name: the learned picker, if any, and the baselines."""
    generator = torch.Generator(device).manual_seed(0)
    learned: dict[str, Score] = {} if network is None else {LEARNED: partial(score_learned, network)}
    return learned | {CONTOUR: score_contour_distance, FLATNESS: score_flatness, RANDOM: partial(score_random, generator=generator)}


def evaluate(
    samples: Samples, states: np.ndarray, unseen: np.ndarray, scores: dict[str, Score], device: torch.device
) -> list[dict[str, Any]]:
    """Evaluate pickers at tried pixels of states: a row for each picker and group of objects: all, the least visible one
    that was tried (hidden), seen, unseen.

    ROC AUC and average precision (AP) are over trials, with inverse probability weights. First choice: success rate of the candidate with
    the largest score; regret: that of the state's best candidate minus it. Figures are `Interval`s by cluster bootstrap over states.
    """
    part = samples.part(states)
    trials, at = part.trials, (part.trials["state"], part.trials["y"], part.trials["x"])
    chunks = [part.sight.part(slice(first, first + CHUNK)).to(device) for first in range(0, len(states), CHUNK)]
    values = {name: torch.cat([score(chunk).cpu() for chunk in chunks]).numpy()[at] for name, score in scores.items()}
    values |= {ANALYTIC: trials["seal"] * trials["wrench"], OWN: (trials["share"] == Share.OWN).astype(float), ORACLE: None}
    is_unseen, groups = np.isin(trials["obj_id"], unseen), {"all": np.ones(len(at[0]), bool)}
    groups["hidden"] = _least_visible(samples.part(states))
    if len(unseen):
        groups |= {"seen": ~is_unseen, "unseen": is_unseen}
    rows = []
    for (group, members), (name, value) in itertools.product(groups.items(), values.items()):
        # The heuristic chooses in the states whose own grasp is in the group.
        kept = members & np.isin(at[0], at[0][members & (value > 0)]) if name == OWN else members
        if kept.any():
            figures = _measure({key: column[kept] for key, column in trials.items()}, value if value is None else value[kept])
            rows.append({"picker": name, "objects": group} | figures)
    return rows


def _least_visible(samples: Samples) -> np.ndarray:
    """Mask of the trials (trial) bool whose object has the smallest visible area of those tried in its state."""
    instance, state = samples.sight.instance.numpy(), samples.trials["state"]
    owner = instance[state, samples.trials["y"], samples.trials["x"]]
    area = np.stack([np.bincount(image.ravel(), minlength=256) for image in instance])[state, owner].astype(float)
    area[owner == 0] = np.inf
    least = np.full(len(instance), np.inf)
    np.minimum.at(least, state, area)
    return np.isfinite(area) & (area == least[state])


def _measure(trials: dict[str, np.ndarray], score: np.ndarray | None) -> dict[str, Any]:
    """AUC, AP, first choice and regret of a score (trial); None: the oracle, which knows the success rate of each candidate."""
    success = trials["success"].astype(float)
    _, which = np.unique(np.stack((trials["state"], trials["candidate"])), axis=1, return_inverse=True)
    rates = (np.bincount(which.ravel(), success) / np.bincount(which.ravel()))[which.ravel()]
    score = rates if score is None else score
    firsts, best = [], []
    for rows in np.split(np.arange(len(success)), np.flatnonzero(np.diff(trials["state"])) + 1):
        tops = rows[score[rows] == score[rows].max()]
        firsts.append(rates[tops].mean())
        best.append(rates[rows].max())
    scored = Scored(score, trials["success"].astype(bool), trials["weight"].astype(float), trials["state"])
    return {
        "states": len(firsts),
        "auc": estimate(scored, weighted_auc, FEW_DRAWS),
        "ap": estimate(scored, average_precision, FEW_DRAWS),
        "first": _mean_over_states(np.array(firsts)),
        "regret": _mean_over_states(np.array(best) - np.array(firsts)),
    }


def _mean_over_states(values: np.ndarray) -> Interval:
    """Mean of values (state), with its bootstrap interval."""
    count = len(values)
    return estimate(Scored(values, np.zeros(count, bool), np.ones(count), np.arange(count)), mean_score)


def show_rows(rows: list[dict[str, Any]]) -> None:
    """Print a table of `evaluate`, each figure with its 95 % interval."""
    print(f"{'picker':14} {'objects':8} {'states':>6}  " + "".join(f"{name:25}" for name in ("AUC", "AP", "first choice", "regret")))
    for row in rows:
        figures = (f"{row[key].value:.3f} ({row[key].low:.3f} to {row[key].high:.3f})" for key in ("auc", "ap", "first", "regret"))
        print(f"{row['picker']:14} {row['objects']:8} {row['states']:6}  " + "".join(f"{figure:25}" for figure in figures))


def _plain(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of `evaluate` for JSON: intervals as value, low and high; None for NaN."""
    return [{key: _numbers(value) if isinstance(value, Interval) else value for key, value in row.items()} for row in rows]


def _numbers(interval: Interval) -> dict[str, float | None]:
    """Fields of an interval; None for NaN."""
    return {name: value if math.isfinite(value) else None for name, value in dataclasses.asdict(interval).items()}


def run_train(options: argparse.Namespace, device: torch.device) -> None:
    """Command `train`: train on all episodes except those held out, and evaluate on these."""
    started = time.perf_counter()
    if not options.picker.parent.is_dir():
        raise ConfigError(f"--picker is {options.picker}; name a file in a folder that exists")
    samples = load_samples(options.folder)
    unseen = split_objects(samples, options.unseen) if options.unseen else np.zeros(0, int)
    held = np.isin(samples.episode, np.unique(samples.episode)[HELD_OUT - 1 :: HELD_OUT])
    if not held.any() or held.all():
        raise DatasetError(f"{options.folder} has picks of {len(np.unique(samples.episode))} episodes; needed: at least {HELD_OUT}")
    used, trials = np.flatnonzero(~held), len(samples.trials["state"])
    print(f"{len(used)} states to train on, {held.sum()} held out, {trials:,} trials; unseen objects: {unseen.tolist()}")
    read, started = time.perf_counter() - started, time.perf_counter()
    network, losses = train(samples.part(used), unseen, options.width, options.steps, device, options.seed, options.batch)
    loss, seconds = sum(losses[-len(losses) // 10 :]) / len(losses[-len(losses) // 10 :]), time.perf_counter() - started
    print(f"read in {read:.1f} s; {len(losses)} steps in {seconds:.1f} s: loss {losses[0]:.3f} to {loss:.3f}")
    height, width = samples.sight.depth.shape[1:]
    save_picker(options.picker, network, options.width, (width, height), unseen, np.unique(samples.trials["obj_id"]))
    rows = evaluate(samples, np.flatnonzero(held), unseen, dense_scores(network, device), device)
    show_rows(rows)
    facts = {"states": len(used), "held_out": int(held.sum()), "trials": trials, "read_s": read, "train_s": seconds, "loss": loss}
    write_json(options.json, {**facts, "unseen": unseen.tolist(), "seed": options.seed, "rows": _plain(rows)})


def run_evaluate(options: argparse.Namespace, device: torch.device) -> None:
    """Command `evaluate`: evaluate a picker and the baselines at the tried pixels of a whole data set, not that of the training."""
    network, parts = load_picker(options.picker, device)
    samples = load_samples(options.folder)
    rows = evaluate(samples, np.arange(len(samples.episode)), np.array(parts["unseen"]), dense_scores(network, device), device)
    show_rows(rows)
    write_json(options.json, {"trials": len(samples.trials["state"]), "rows": _plain(rows)})


def run_simulation(options: argparse.Namespace, device: torch.device) -> None:
    """Command `run`: success rate of each picker's first choice from the same piles, and optionally of bin emptying."""
    from synpick_warp.environment.make import make_picking
    from tools.examples import picking_runs as runs

    network, parts = load_picker(options.picker, device)
    named = {"seen": sorted(set(parts["objects"]) - set(parts["unseen"])), "unseen": parts["unseen"], "all": []}[options.objects]
    if options.objects != "all" and not named:
        raise ConfigError(f"--objects is {options.objects}, but {options.picker} was trained with --unseen 0")
    config = configure(options, {})
    if named:
        most = max(1, min(MOST_OF_EACH, config.arrangement.max_objects // len(named)))
        config = configure(options, {"arrangement.counts": {str(obj_id): [1, most] for obj_id in named}})
    choice = runs.choose_environment(options.task, options.worlds, tuple(parts["size"]), options.seed, LONGEST)
    environment = make_picking(choice, config, perceives=True)
    pickers = {name: runs.DenseChoice(score) for name, score in dense_scores(network, device).items()}
    pickers |= {OWN: runs.choose_planned, ANALYTIC: runs.AnalyticChoice(environment)}
    chosen = {name: pickers[name] for name in options.pickers}
    facts = {"task": options.task, "objects": options.objects, "seed": options.seed}
    results, started = [], time.perf_counter()
    for found, piles in runs.run_first_choices(environment, chosen, options.attempts):
        print(f"first choice, task {options.task}, {piles} piles of {options.objects} objects, in {time.perf_counter() - started:.0f} s")
        results = [
            _show_rate({"picker": name, "run": "first choice"}, torch.tensor(count), outcomes) for name, (count, outcomes) in found.items()
        ]
        write_json(options.json, facts | {"rows": results})
    for name in chosen if options.until_empty else ():
        started = time.perf_counter()
        total = runs.run_until_empty(environment, chosen[name])
        print(f"until empty: {total.empty} of {environment.count} bins emptied in {time.perf_counter() - started:.0f} s")
        emptied = {"picker": name, "run": "until empty", "bins": environment.count, "emptied": total.empty}
        results.append(_show_rate(emptied, total.picked, total.outcomes, total.attempts))
        write_json(options.json, facts | {"rows": results})
        environment.episodes.count[:] -= 1  # The next picker gets the same piles.


def _show_rate(facts: dict[str, Any], picked: torch.Tensor, outcomes: torch.Tensor, attempts: torch.Tensor | None = None) -> dict[str, Any]:
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


COMMANDS = {"train": run_train, "evaluate": run_evaluate, "run": run_simulation}


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
    parser.add_argument(
        "command", choices=COMMANDS, help="train and score on held-out episodes; evaluate on another set; run in simulation"
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="data set with picks and images (train, evaluate)")
    parser.add_argument("--picker", type=Path, default=Path("picker.pt"), metavar="FILE", help="file of the network (default: picker.pt)")
    parser.add_argument("--width", type=positive_count, default=24, help="channels of the network's first level (default: 24)")
    parser.add_argument("--steps", type=positive_count, default=4000, help="steps of training (default: 4000)")
    parser.add_argument("--batch", type=positive_count, default=16, help="images of a step (default: 16)")
    parser.add_argument("--unseen", type=int, default=0, help="objects that are not trained on (default: 0)")
    parser.add_argument("--objects", choices=("all", "seen", "unseen"), default="all", help="objects of the piles (run; default: all)")
    parser.add_argument("--worlds", type=positive_count, default=512, help="piles at a time (run; default: 512)")
    parser.add_argument("--task", choices=(PICK, TARGET), default=PICK, help="pick any object, or the most occluded one (run)")
    names = make_names_parser(PICKERS, "picker")
    parser.add_argument("--pickers", type=names, default=PICKERS, help=f"those to run, separated by commas (default: {','.join(PICKERS)})")
    parser.add_argument("--attempts", type=int, default=1000, help="least number of first choices, 0: none (run; default: 1000)")
    parser.add_argument("--until-empty", action="store_true", help="also pick until the bins are empty (run)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
