"""Train a suction picker (pixel-wise success prediction by a U-Net) on simulated picks, and run it beside the paper's heuristic.

The network predicts the logit of success at each pixel of camera 0's depth image; it learns from tried pixels, and from pixels without
object as failures. The camera looks straight down on a cell without a preferred side, so a mirrored image shows a possible state. Needs
PyTorch; the defaults are for a GPU.

    synpick-warp bake --config synpick --episodes 300 --formats shards,picks --set cameras.resolution=[320,180] --out DATA
    python -m tools.examples.train_picker train DATA --picker picker.pt
    python -m tools.examples.train_picker run --picker picker.pt --config synpick --worlds 512 --attempts 1000
"""

import argparse
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import warp as wp

try:
    import torch  # pyright: ignore[reportMissingImports]
    from torch.nn import functional  # pyright: ignore[reportMissingImports]

    from tools.examples.train_online import Network, schedule
except ModuleNotFoundError as missing:
    raise SystemExit(f"train_picker: {missing.name} is not installed; pip install torch") from None

import synpick_warp
from synpick_warp.apps.statistics.picks import Interval, Scored, estimate, weighted_auc
from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.dataset.reading import Episode
from synpick_warp.dataset.view import find_pixels
from synpick_warp.environment.make import make_picking
from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.environment.settings import ATTEMPT, DISABLED, PICK, PIXEL, POINT, TARGET, TORCH, make_choice
from synpick_warp.errors import ConfigError, DatasetError, SynpickError
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.system.hardware.cores import map_in_threads
from synpick_warp.system.hardware.device import pick_device
from tools.options import configure, fail, make_parser, positive_count, write_json

HELD_OUT = 5
"""Stride of the train/test split: every fifth episode is held out from training."""
LABELS = ("success", "intended")
"""Outcomes that the network predicts, a channel each: any object picked; that of the pixel picked."""
EMPTY_PIXELS, EMPTY_WEIGHT = 64, 0.2
"""Negative samples of an image, drawn from pixels without object, and their weight in the loss against that of the trials."""
LEARNING_RATE, WARM_UP, DECAY = 2e-3, 0.05, 1e-2
SCALE = 10.0
"""Depth differences are given in units of 0.1 m."""
SMOOTHING = 3
"""Side of the window over which predictions are averaged [px]: a pick lands within half a pixel of its target, and labels are sparse."""
CHUNK = 16
"""Images that are scored at a time."""
DRAWS = 200
"""Bootstrap resamples of an AUC."""
LEARNED, OWN = "learned", "heuristic"


# ---- data ----


@dataclass(frozen=True, eq=False)
class PickSamples:
    """Images of camera 0 at the states of a data set, and the picks that were tried from them."""

    depth: torch.Tensor
    """Planar depth (state, H, W) float32 [m]; 0: nothing."""
    seen: torch.Tensor
    """Pixels that show objects (state, H, W) bool."""
    focal: float
    """Focal length [px]."""
    episode: np.ndarray
    """Episode of each state (state) int."""
    trials: dict[str, np.ndarray]
    """Columns by trial, sorted by state: `state`, `x` and `y` [px], LABELS, `weight`."""

    def part(self, states: np.ndarray) -> "PickSamples":
        """Subset of the states, in ascending order; `state` of trials becomes the position in `states`."""
        place = np.full(len(self.episode), -1)
        place[states] = np.arange(len(states))
        kept = place[self.trials["state"]] >= 0
        rows = {name: values[kept] for name, values in self.trials.items()}
        chosen = torch.from_numpy(states)
        return PickSamples(self.depth[chosen], self.seen[chosen], self.focal, self.episode[states], rows | {"state": place[rows["state"]]})


def load_samples(folder: Path) -> PickSamples:
    """Read all states of a data set with picks and images of camera 0, on all cores; raises DatasetError if it lacks them."""
    data = synpick_warp.open(folder)
    read = map_in_threads(lambda index: list(_read_states(data[index])), list(data))
    shots = [shot for part in read for shot in part]
    if not shots:
        needed = "bake it with picks.candidates and --formats shards,picks"
        raise DatasetError(f"{folder} has no state that was tried and is in a picture; {needed}")
    depth, seen = (torch.from_numpy(np.stack([getattr(view, name) for view, _ in shots])) for name in ("depth", "seen"))
    trials = {name: np.concatenate([rows[name] for _, rows in shots]) for name in shots[0][1]}
    trials["state"] = np.repeat(np.arange(len(shots)), [len(rows["x"]) for _, rows in shots])
    return PickSamples(depth, seen, shots[0][0].focal, np.repeat(list(data), [len(part) for part in read]), trials)


@dataclass(frozen=True, eq=False)
class _Image:
    """Image of a state (H, W): depth [m] and pixels that show objects; focal length [px]."""

    depth: np.ndarray
    seen: np.ndarray
    focal: float


def _read_states(episode: Episode) -> Iterator[tuple[_Image, dict[str, np.ndarray]]]:
    """Images of the states of an episode that are in a picture, with the columns of the trials whose grasp points it contains."""
    trials = episode.picks
    for state in episode.pick_states:
        if int(state["frame"]) in episode.frames(int(state["camera"])):
            view, rows = episode.view(int(state["frame"]), int(state["camera"])), trials[trials["state"] == state["state"]]
            pixels = find_pixels(view, rows)
            inside = ((pixels >= 0) & (pixels < view.size)).all(axis=1)
            columns = {name: np.asarray(rows[name][inside]) for name in (*LABELS, "weight")}
            image = _Image(view.depth, view.masks.any(axis=0), float(view.intrinsics[0, 0]))
            yield image, columns | {"x": pixels[inside, 0], "y": pixels[inside, 1]}


# ---- network ----


def make_inputs(depth: torch.Tensor, focal: float) -> torch.Tensor:
    """Network input (B, 5, H, W) of depth (B, H, W) [m]: depth less the image's median [0.1 m], surface normals, and valid-depth mask."""
    known = (depth > 0.0).float()
    middle = depth.flatten(1).median(dim=1).values[:, None, None]
    return torch.cat((((depth - middle) * known * SCALE)[:, None], find_normals(depth, focal) * known[:, None], known[:, None]), dim=1)


def find_normals(depth: torch.Tensor, focal: float) -> torch.Tensor:
    """Surface normals towards the camera (B, 3, H, W), by central differences of depth (B, H, W) [m]; camera frame, with weak perspective
    (scaled orthography) about each pixel."""
    padded = functional.pad(depth[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    across, along = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2], padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
    slope = focal / (2.0 * depth.clamp(min=1e-3))
    return functional.normalize(torch.stack((across * slope, along * slope, -torch.ones_like(depth)), dim=1), dim=1)


def train(samples: PickSamples, width: int, steps: int, device: torch.device, seed: int, batch: int) -> tuple[Network, list[float]]:
    """Train a U-Net (AdamW, cosine decay) on trials of mirrored images; returns it and the loss of each step."""
    torch.manual_seed(seed)
    network = Network(len(LABELS), width, inputs=5).to(device)
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=DECAY)
    target = torch.from_numpy(np.stack([samples.trials[name] for name in LABELS], axis=1)).float()
    at = torch.from_numpy(np.stack([samples.trials[name] for name in ("state", "y", "x")])).long()
    bounds = np.searchsorted(samples.trials["state"], np.arange(len(samples.episode) + 1))
    random, losses = np.random.default_rng(seed), []
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * schedule(step / steps, WARM_UP)
        states = random.choice(len(samples.episode), min(batch, len(samples.episode)), replace=False)
        rows = np.concatenate([np.arange(bounds[state], bounds[state + 1]) for state in states])
        place = torch.from_numpy(np.repeat(np.arange(len(states)), bounds[states + 1] - bounds[states]))
        flips = [axis for axis in (1, 2) if random.random() < 0.5]
        logits = network(make_inputs(samples.depth[states].flip(flips).to(device), samples.focal)).flip([axis + 1 for axis in flips])
        tried = logits[place, :, at[1, rows], at[2, rows]]
        loss = functional.binary_cross_entropy_with_logits(tried, target[rows].to(device))
        seen = samples.seen[states].to(device)
        empty = torch.randint(seen[0].numel(), (len(states), EMPTY_PIXELS), device=device)
        free = (~seen.flatten(1)).gather(1, empty).float()
        negative = functional.softplus(logits.flatten(2).gather(2, empty[:, None].expand(-1, len(LABELS), -1))).mean(dim=1)
        loss = loss + EMPTY_WEIGHT * (free * negative).sum() / free.sum().clamp(min=1.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
    return network.eval(), torch.stack(losses).tolist()


def predict(network: torch.nn.Module, depth: torch.Tensor, focal: float, label: str) -> torch.Tensor:
    """Probability of a label at each pixel (B, H, W), averaged over the four mirror images and a window."""
    total = torch.zeros_like(depth)
    with torch.no_grad():
        for first in range(0, len(depth), CHUNK):
            part = slice(first, first + CHUNK)
            for axes in ((), (1,), (2,), (1, 2)):
                logits = network(make_inputs(depth[part].flip(axes), focal))[:, LABELS.index(label)]
                total[part] += logits.sigmoid().flip(axes) / 4
    return functional.avg_pool2d(total[:, None], SMOOTHING, 1, SMOOTHING // 2, count_include_pad=False)[:, 0]


def load_picker(path: Path, device: torch.device) -> tuple[Network, dict[str, Any]]:
    """Read a file of `run_train`: network and all its entries; raises DatasetError if it is no such file."""
    try:
        parts = torch.load(path, map_location=device, weights_only=True)
        network = Network(len(LABELS), parts["width"], inputs=5).to(device)
        network.load_state_dict(parts["weights"])
    except (OSError, EOFError, KeyError, TypeError, RuntimeError, ValueError, UnpicklingError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise DatasetError(f"{path} is no picker that `train` wrote: {reason}") from None
    return network.eval(), parts


def measure_auc(network: torch.nn.Module, samples: PickSamples, device: torch.device) -> Interval:
    """AUC of predictions at tried pixels, with inverse probability weights, and its interval by cluster bootstrap over states."""
    trials, value = samples.trials, predict(network, samples.depth.to(device), samples.focal, LABELS[0]).cpu().numpy()
    score = value[trials["state"], trials["y"], trials["x"]]
    return estimate(Scored(score, trials["success"].astype(bool), trials["weight"].astype(float), trials["state"]), weighted_auc, DRAWS)


# ---- simulation ----


def choose_pixels(network: torch.nn.Module, environment: PickingEnvironment, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Pixels (B, 2) with the largest prediction; with a target, on that object alone."""
    config = environment.worlds.simulation.config
    camera = make_cameras(config.rig)[config.rig.index(config.perception.camera)]
    shown = obs["instances"]
    allowed = (shown > 0) & (shown <= MAX_INSTANCES) if "target_mask" not in obs else obs["target_mask"] > 0
    focal = float(camera.matrix[0, 0]) * obs["depth"].shape[2] / camera.width
    value = predict(network, obs["depth"].clone(), focal, LABELS["target_mask" in obs])
    place = torch.where(allowed, value, value - 1.0).flatten(1).argmax(dim=1)
    return torch.stack((place % value.shape[2], place // value.shape[2]), dim=1)


def planned_grasps(environment: PickingEnvironment) -> torch.Tensor:
    """Grasps (B, 6) that the paper's heuristic has planned; the environment perceives (`make_picking`)."""
    plan = environment.worlds.simulation.plan
    return torch.cat([wp.to_torch(part)[: environment.count] for part in (plan.point, plan.normal)], dim=1).clone()


def try_both(network: torch.nn.Module, environment: PickingEnvironment) -> dict[str, int]:
    """Successes of the first choices of the network and of the heuristic, from the same new piles."""
    environment.reset()
    start, choice, picked = environment.get_state(), environment.choice, {}
    environment.bounds = np.full(3, -np.inf), np.full(3, np.inf)  # Plans may be beyond the rim.
    for name, action in ((LEARNED, PIXEL), (OWN, POINT)):
        obs = environment.set_state(start)
        actions = choose_pixels(network, environment, obs) if name == LEARNED else planned_grasps(environment)
        environment.choice = replace(choice, action=action)
        picked[name] = int(environment.step(actions).reward.sum())
        environment.choice = choice
    environment.set_state(start)
    return picked


def run_simulation(options: argparse.Namespace, device: torch.device) -> None:
    """Command `run`: success rate of first choices, the network's and the heuristic's, from the same piles."""
    network, parts = load_picker(options.picker, device)
    size, obs = tuple(parts["size"]), ("depth", "instances")
    choice = make_choice(options.task, options.worlds, obs, size, PIXEL, DISABLED, TORCH, options.seed, None, None, ATTEMPT)
    environment, piles, picked = make_picking(choice, configure(options, {}), perceives=True), 0, {LEARNED: 0, OWN: 0}
    while piles < options.attempts:
        found = try_both(network, environment)
        piles, picked = piles + environment.count, {name: picked[name] + count for name, count in found.items()}
        print(f"{piles} piles, task {options.task}:", ", ".join(f"{name} {100 * count / piles:.2f} %" for name, count in picked.items()))
        write_json(options.json, {"task": options.task, "seed": options.seed, "piles": piles, "picked": picked})


def run_train(options: argparse.Namespace, device: torch.device) -> None:
    """Command `train`: train on all episodes except those held out, and measure the AUC on these."""
    if not options.picker.parent.is_dir():
        raise ConfigError(f"--picker is {options.picker}; name a file in a folder that exists")
    samples = load_samples(options.folder)
    held = np.isin(samples.episode, np.unique(samples.episode)[HELD_OUT - 1 :: HELD_OUT])
    if not held.any() or held.all():
        raise DatasetError(f"{options.folder} has picks of {len(np.unique(samples.episode))} episodes; needed: at least {HELD_OUT}")
    started, used = time.perf_counter(), np.flatnonzero(~held)
    network, losses = train(samples.part(used), options.width, options.steps, device, options.seed, options.batch)
    seconds, (height, width) = time.perf_counter() - started, samples.depth.shape[1:]
    torch.save({"width": options.width, "size": (width, height), "weights": network.state_dict()}, options.picker)
    auc = measure_auc(network, samples.part(np.flatnonzero(held)), device)
    print(f"{len(used)} states, {len(losses)} steps in {seconds:.1f} s: loss {losses[0]:.3f} to {losses[-1]:.3f}")
    print(f"{held.sum()} held-out states: AUC {auc.value:.3f} ({auc.low:.3f} to {auc.high:.3f})")
    write_json(options.json, {"states": len(used), "held_out": int(held.sum()), "train_s": seconds, "losses": losses, "auc": vars(auc)})


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
    parser.add_argument("--attempts", type=positive_count, default=1000, help="piles, at least (run; default: 1000)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
