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
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch  # pyright: ignore[reportMissingImports]
    from torch.nn import functional  # pyright: ignore[reportMissingImports]
except ModuleNotFoundError as missing:
    raise SystemExit(f"train_picker: {missing.name} is not installed; pip install torch") from None

import synpick_warp
from synpick_warp.apps.statistics.ranking import Interval, Scored, estimate, weighted_auc
from synpick_warp.codes import Share
from synpick_warp.dataset.grasp_maps import find_pixels
from synpick_warp.dataset.reading import Episode
from synpick_warp.dataset.view import View
from synpick_warp.errors import ConfigError, DatasetError, SynpickError
from synpick_warp.system.hardware.device import pick_device
from tools.examples.picking_scores import (
    Sight,
    average_precision,
    find_normals,
    mean_score,
    score_contour_distance,
    score_flatness,
    score_random,
    wilson,
)
from tools.examples.train_online import Network
from tools.options import configure, fail, make_parser, positive_count

HELD_OUT = 5
"""Stride of the train/test split: every fifth episode is held out from training."""
EMPTY_PIXELS = 32
"""Negative samples of an image: pixels without object, learnt as failures."""
LIGHTEST, HEAVIEST = 0.1, 10.0
"""Clipping range of inverse probability weights, relative to the image's mean: a few are very large, and the planned grasp has 0."""
LEARNING_RATE, WARM_UP, BATCH = 2e-3, 0.05, 16
FEW_DRAWS = 200
"""Bootstrap resamples of statistics over all trials."""
HINTS = 0.3
"""Factor on the auxiliary loss: prediction of the analytic maps, where a data set has them."""
MAPS = ("suction_seal", "suction_wrench")
MOST_OF_EACH = 2
"""Most instances of an object in piles that are limited to seen or unseen objects."""
RANDOM, CONTOUR, FLATNESS, LEARNED = "random", "contour", "flatness", "learned"
ANALYTIC, OWN, ORACLE = "seal x wrench", "heuristic", "oracle"
Score = Callable[[Sight], torch.Tensor]
_KEPT = ("frame", "candidate", "repeat", "obj_id", "share", "weight", "seal", "wrench", "success")


@dataclass(frozen=True, eq=False)
class Samples:
    """Training samples: images of camera 0 at the states of a data set, and the trials with their state and pixel."""

    sight: Sight
    """Images on the CPU, a row for each state."""
    maps: torch.Tensor | None
    """Analytic seal and wrench maps (state, 2, H, W) float32; None: the data set has none."""
    episode: np.ndarray
    """Episode of each state (state) int."""
    trials: dict[str, np.ndarray]
    """Columns of the trials, and `state`, `x` and `y` [px] (trial)."""

    def trials_of(self, states: np.ndarray) -> dict[str, np.ndarray]:
        """Trials of some states; their `state` becomes the position in `states`."""
        place = np.full(len(self.episode), -1)
        place[states] = np.arange(len(states))
        kept = place[self.trials["state"]] >= 0
        rows = {name: values[kept] for name, values in self.trials.items()}
        return rows | {"state": place[rows["state"]]}


def load_samples(folder: Path) -> Samples:
    """Read all states of a data set with picks and images of camera 0; raises DatasetError if it lacks them."""
    data = synpick_warp.open(folder)
    views, episodes, parts, focal = [], [], [], 0.0
    for index in data:
        for view, trials in _views_of(data[index]):
            pixels = find_pixels(view, trials)
            inside = ((pixels >= 0) & (pixels < view.size)).all(axis=1)
            rows = {name: trials[name][inside] for name in _KEPT}
            parts.append(rows | {"state": np.full(inside.sum(), len(views)), "x": pixels[inside, 0], "y": pixels[inside, 1]})
            # Each image is kept, not the view, which would keep its files open.
            views.append((view.depth, _segment(view), _maps(view)))
            episodes.append(index)
            focal = float(view.intrinsics[0, 0])
    if not views:
        raise DatasetError(f"{folder} has no state that was tried; bake it with picks.candidates and --formats shards,picks")
    depth, instance, maps = zip(*views, strict=True)
    sight = Sight(*(torch.from_numpy(np.stack(images)) for images in (depth, instance)), focal)
    known = None if any(one is None for one in maps) else torch.from_numpy(np.stack(maps))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Samples(sight, known, np.array(episodes), columns)


def _views_of(episode: Episode) -> Iterator[tuple[View, np.ndarray]]:
    """View of camera 0 of each state of an episode, with its trials."""
    trials, states = episode.picks, episode.pick_states
    for state in states:
        yield episode.view(int(state["frame"]), int(state["camera"])), trials[trials["state"] == state["state"]]


def _segment(view: View) -> np.ndarray:
    """Visible instances (H, W) uint8: 1 + row of the ground truth; 0: none."""
    masks = view.masks
    return (masks * np.arange(1, len(masks) + 1)[:, None, None]).sum(axis=0).astype(np.uint8)


def _maps(view: View) -> np.ndarray | None:
    """Analytic seal and wrench maps (2, H, W) float32; None: the view has none."""
    return np.stack([view.layer(name) for name in MAPS]).astype(np.float32) if set(MAPS) <= set(view.layers) else None


def make_inputs(sight: Sight) -> torch.Tensor:
    """Network input (B, 5, H, W): depth less the image's median [0.1 m], surface normals (3), and valid-depth mask."""
    known = (sight.depth > 0.0).float()
    middle = sight.depth.flatten(1).median(dim=1).values[:, None, None]
    return torch.cat((((sight.depth - middle) * known * 10.0)[:, None], find_normals(sight.depth, sight.focal), known[:, None]), dim=1)


def split_objects(samples: Samples, unseen: int) -> np.ndarray:
    """Hold out objects: obj_ids of `unseen` of the tried ones, drawn with a fixed seed; raises ConfigError if too few were tried."""
    objects = np.unique(samples.trials["obj_id"])
    if unseen >= len(objects):
        raise ConfigError(f"--unseen is {unseen}, but {len(objects)} objects were tried; name fewer")
    return np.sort(np.random.default_rng(0).permutation(objects)[:unseen])


def train(
    samples: Samples, states: np.ndarray, unseen: np.ndarray, width: int, steps: int, device: torch.device
) -> tuple[Network, list[float]]:
    """Train a U-Net (AdamW, cosine decay) on the trials of states, except on unseen objects; returns it and the loss of each step."""
    torch.manual_seed(0)
    trials = samples.trials_of(states)
    seen = ~np.isin(trials["obj_id"], unseen)
    trials = {name: torch.from_numpy(np.ascontiguousarray(values[seen])) for name, values in trials.items()}
    sight = samples.sight.part(torch.from_numpy(states))
    rows = [torch.nonzero(trials["state"] == state)[:, 0] for state in range(len(states))]
    network = Network(1 + len(MAPS), width, inputs=5).to(device)
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=1e-2)
    generator, losses = torch.Generator().manual_seed(0), []
    for step in range(steps):
        done = step / steps
        factor = done / WARM_UP if done < WARM_UP else 0.5 + 0.5 * math.cos(math.pi * (done - WARM_UP) / (1 - WARM_UP))
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * max(factor, 0.01)
        chosen = torch.randint(len(states), (min(BATCH, len(states)),), generator=generator)
        part = sight.part(chosen)
        flips = [axis for axis in (1, 2) if torch.rand(1, generator=generator) < 0.5]
        # The output is flipped back, so that pixels stay where they are.
        mirrored = Sight(part.depth.flip(flips).to(device), part.instance, part.focal)
        output = network(make_inputs(mirrored)).flip([axis + 1 for axis in flips])
        maps = None if samples.maps is None else samples.maps[torch.from_numpy(states)[chosen]].to(device)
        loss = _loss(output, trials, [rows[state] for state in chosen.tolist()], part.instance, maps, generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return network.eval(), losses


def _loss(
    output: torch.Tensor,
    trials: dict[str, torch.Tensor],
    rows: list[torch.Tensor],
    instance: torch.Tensor,
    maps: torch.Tensor | None,
    generator: torch.Generator,
) -> torch.Tensor:
    """Weighted binary cross entropy at tried pixels and negative samples, plus the auxiliary loss of the analytic maps on objects."""
    batch = torch.repeat_interleave(torch.arange(len(rows)), torch.tensor([len(part) for part in rows]))
    index = torch.cat(rows)
    weight = torch.cat([trials["weight"][part] / trials["weight"][part].mean().clamp(min=1e-9) for part in rows]).clamp(LIGHTEST, HEAVIEST)
    empty = torch.nonzero(instance == 0)
    empty = empty[torch.randint(len(empty), (EMPTY_PIXELS * len(rows) * bool(len(empty)),), generator=generator)]
    place = torch.cat((torch.stack((batch, trials["y"][index], trials["x"][index]), dim=1), empty)).to(output.device)
    target = torch.cat((trials["success"][index].float(), torch.zeros(len(empty)))).to(output.device)
    weight = torch.cat((weight.float(), torch.ones(len(empty)))).to(output.device)
    logit = output[place[:, 0], 0, place[:, 1], place[:, 2]]
    loss = (weight * functional.binary_cross_entropy_with_logits(logit, target, reduction="none")).sum() / weight.sum()
    if maps is None:
        return loss
    visible = (instance > 0).to(output.device)[:, None].expand_as(maps)
    return loss + HINTS * functional.binary_cross_entropy_with_logits(output[:, 1:][visible], maps[visible])


def score_learned(network: Network, sight: Sight) -> torch.Tensor:
    """Success probability predicted by the network at each pixel (B, H, W)."""
    with torch.no_grad():
        return torch.cat(
            [network(make_inputs(sight.part(slice(at, at + BATCH))))[:, 0].sigmoid() for at in range(0, len(sight.depth), BATCH)]
        )


def dense_scores(network: Network | None, device: torch.device) -> dict[str, Score]:
    """Score functions by picker name: the learned picker, if any, and the baselines."""
    generator = torch.Generator(device).manual_seed(0)
    learned: dict[str, Score] = {} if network is None else {LEARNED: partial(score_learned, network)}
    return learned | {CONTOUR: score_contour_distance, FLATNESS: score_flatness, RANDOM: partial(score_random, generator=generator)}


def evaluate(
    samples: Samples, states: np.ndarray, unseen: np.ndarray, scores: dict[str, Score], device: torch.device
) -> list[dict[str, Any]]:
    """Evaluate pickers at tried pixels of states: a row for each picker and group of objects (all, seen, unseen).

    ROC AUC and average precision (AP) are over trials, with inverse probability weights. First choice: success rate of the candidate with
    the largest score; regret: that of the state's best candidate minus it. Figures are `Interval`s by cluster bootstrap over states.
    """
    trials, sight = samples.trials_of(states), samples.sight.part(torch.from_numpy(states))
    at = trials["state"], trials["y"], trials["x"]
    moved = Sight(sight.depth.to(device), sight.instance.to(device), sight.focal)
    values = {name: score(moved).cpu().numpy()[at] for name, score in scores.items()}
    values |= {ANALYTIC: trials["seal"] * trials["wrench"], OWN: (trials["share"] == Share.OWN).astype(float), ORACLE: None}
    is_unseen, groups = np.isin(trials["obj_id"], unseen), {"all": np.ones(len(at[0]), bool)}
    if len(unseen):
        groups |= {"seen": ~is_unseen, "unseen": is_unseen}
    return [
        {"picker": name, "objects": group}
        | _measure({key: column[kept] for key, column in trials.items()}, value if value is None else value[kept])
        for group, kept in groups.items()
        for name, value in values.items()
    ]


def _measure(trials: dict[str, np.ndarray], score: np.ndarray | None) -> dict[str, Any]:
    """AUC, AP, first choice and regret of a score (trial); None: the oracle, which knows the success rate of each candidate."""
    success = trials["success"].astype(float)
    _, which = np.unique(np.stack((trials["state"], trials["candidate"])), axis=1, return_inverse=True)
    rates = (np.bincount(which.ravel(), success) / np.bincount(which.ravel()))[which.ravel()]
    score = rates if score is None else score
    firsts, best = [], []
    for state in np.unique(trials["state"]):
        rows = np.flatnonzero(trials["state"] == state)
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


def save_picker(path: Path, network: Network, width: int, size: tuple[int, int], unseen: np.ndarray, everything: np.ndarray) -> None:
    """Write a network's weights with width, image size, held-out objects (`unseen`) and all tried objects (`everything`)."""
    parts = {"width": width, "size": size, "unseen": unseen.tolist(), "objects": everything.tolist(), "weights": network.state_dict()}
    torch.save(parts, path)


def load_picker(path: Path, device: torch.device) -> tuple[Network, dict[str, Any]]:
    """Read a file of `save_picker`: network and all its entries; raises DatasetError if it is no such file."""
    try:
        parts = torch.load(path, map_location=device, weights_only=True)
        network = Network(1 + len(MAPS), parts["width"], inputs=5).to(device)
        network.load_state_dict(parts["weights"])
    except (OSError, KeyError, TypeError, RuntimeError, ValueError) as error:
        raise DatasetError(f"{path} is no picker that `train` wrote: {str(error).splitlines()[0]}") from None
    return network.eval(), parts


def run_train(options: argparse.Namespace, device: torch.device) -> None:
    """Command `train`: train on all episodes except those held out, and evaluate on these."""
    samples = load_samples(options.folder)
    unseen = split_objects(samples, options.unseen) if options.unseen else np.zeros(0, int)
    held = np.isin(samples.episode, np.unique(samples.episode)[HELD_OUT - 1 :: HELD_OUT])
    if not held.any() or held.all():
        raise DatasetError(f"{options.folder} has picks of {len(np.unique(samples.episode))} episodes; needed: at least {HELD_OUT}")
    used, started = np.flatnonzero(~held), time.perf_counter()
    print(
        f"{len(used)} states to train on, {held.sum()} held out, {len(samples.trials['state']):,} trials; unseen objects: {unseen.tolist()}"
    )
    network, losses = train(samples, used, unseen, options.width, options.steps, device)
    tail = losses[-max(1, len(losses) // 10) :]
    print(f"{len(losses)} steps in {time.perf_counter() - started:.1f} s: loss {losses[0]:.3f} to {sum(tail) / len(tail):.3f}")
    height, width = samples.sight.depth.shape[1:]
    save_picker(options.picker, network, options.width, (width, height), unseen, np.unique(samples.trials["obj_id"]))
    show_rows(evaluate(samples, np.flatnonzero(held), unseen, dense_scores(network, device), device))


def run_evaluate(options: argparse.Namespace, device: torch.device) -> None:
    """Command `evaluate`: evaluate a picker and the baselines at the tried pixels of a whole data set, not that of the training."""
    network, parts = load_picker(options.picker, device)
    samples = load_samples(options.folder)
    show_rows(evaluate(samples, np.arange(len(samples.episode)), np.array(parts["unseen"]), dense_scores(network, device), device))


def run_simulation(options: argparse.Namespace, device: torch.device) -> None:
    """Command `run`: success rate of each picker's first choice from the same piles, and optionally bin emptying by the learned one."""
    from synpick_warp.environment.make import make_picking
    from tools.examples.picking_runs import choose_environment, run_first_choices, run_until_empty

    network, parts = load_picker(options.picker, device)
    named = {"seen": sorted(set(parts["objects"]) - set(parts["unseen"])), "unseen": parts["unseen"], "all": []}[options.objects]
    if options.objects != "all" and not named:
        raise ConfigError(f"--objects is {options.objects}, but {options.picker} was trained with --unseen 0")
    counts = {"arrangement.counts": {str(obj_id): [0, MOST_OF_EACH] for obj_id in named}} if named else {}
    config, scores = configure(options, counts), dense_scores(network, device)
    environment = make_picking(choose_environment(options.worlds, tuple(parts["size"]), options.seed), config)
    started = time.perf_counter()
    picked, piles = run_first_choices(environment, scores, options.attempts)
    print(f"first choice, {piles} piles of {options.objects} objects, in {time.perf_counter() - started:.0f} s")
    for name, count in picked.items():
        print("  {:10} {:.3f} ({:.3f} to {:.3f})".format(name, count / piles, *wilson(count, piles)))
    if options.until_empty:
        total = run_until_empty(environment, scores[LEARNED])
        low, high = wilson(total.picked, total.attempts)
        rate = f"{total.picked / total.attempts:.3f} ({low:.3f} to {high:.3f})"
        print(f"until empty: {total.picked} of {total.attempts} attempts, {rate}; {total.empty} of {total.bins} bins emptied")


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
    parser = make_parser(__doc__, "config", "models", "lights", "seed", "set")
    parser.add_argument(
        "command", choices=COMMANDS, help="train and score on held-out episodes; evaluate on another set; run in simulation"
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="data set with picks and images (train, evaluate)")
    parser.add_argument("--picker", type=Path, default=Path("picker.pt"), help="file of the network (default: picker.pt)")
    parser.add_argument("--device", default="auto", help="cpu, cuda:N or auto (default: auto)")
    parser.add_argument("--width", type=positive_count, default=24, help="channels of the network's first level (default: 24)")
    parser.add_argument("--steps", type=positive_count, default=2000, help="steps of training (default: 2000)")
    parser.add_argument("--unseen", type=int, default=0, help="objects that are not trained on (default: 0)")
    parser.add_argument("--objects", choices=("all", "seen", "unseen"), default="all", help="objects of the piles (run; default: all)")
    parser.add_argument("--worlds", type=positive_count, default=512, help="piles at a time (run; default: 512)")
    parser.add_argument("--attempts", type=positive_count, default=1000, help="least number of first choices (run; default: 1000)")
    parser.add_argument("--until-empty", action="store_true", help="also pick until the bins are empty (run)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
