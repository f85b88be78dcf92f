"""Sim-to-real semantic segmentation: trains on synthetic views only, evaluates on annotated photographs (mIoU, recall, background).

Each seed has its own piles, pictures and network; values are means over seeds with 95 % intervals. The same held-out synthetic views are
evaluated for all seeds, for comparison. Needs PyTorch; the defaults are for a GPU.

    python -m tools.reports.real --real REAL --models YCB --lights HDRI --seeds 3 --json real.json --pictures OUT
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch  # pyright: ignore[reportMissingImports]

    from tools.reports.real.scores import NetworkScores, draw_overlay, predict, score, score_pool
    from tools.reports.real.training import BLOCK, Recipe, Trained, train
    from tools.reports.real.views import ViewPool, ViewSource, hold_out
except ModuleNotFoundError as missing:
    raise SystemExit(f"reports.real: {missing.name} is not installed; pip install torch") from None

from rich.console import Console
from scipy import stats

from synpick_warp.configs.cell.rig import resized
from synpick_warp.errors import ConfigError, SynpickError
from synpick_warp.system.hardware.device import pick_device
from tools.figures import describe_run, write_run
from tools.options import MeasuredRow, configure, existing_folder, fail, make_parser, number_in, positive_count, print_rows
from tools.reports.real_frames import RealFrame, read_frames

TRAINING, HELD_OUT = range(1_000_000), range(1_000_000, 1_100_000)
"""Episodes to train on, and to measure on."""
FEW_WORLDS = 64
"""Maximum number of worlds for held-out views."""
PRESET = "tabletop-train"
"""Default preset of the stream."""
VIEWS_PER_BATCH = 48
"""Views that are rendered together: more than a batch of the training, so that the GPU is busy."""
MODELS = 21
"""Largest obj_id: networks have a class for each, and class 0 for pixels without object."""
COUNTS = {
    "views": (24_000, "views of the stream"),
    "seeds": (3, "trainings, each with piles of its own"),
    "worlds": (512, "worlds simulated in parallel"),
    "held-out": (400, "synthetic views to measure on"),
    "capacity": (24_000, "views in the pool, at most"),
    "batch": (16, "views of a batch"),
    "width": (64, "channels of the network's first level"),
    "stride": (2, "every n-th frame of an episode is taken"),
    "enlarge": (2, "factor by which the resolution of all cameras is enlarged"),
}
"""Options that are integers above 0: default and meaning."""
OWN = {
    **{name: {"type": positive_count, "default": value, "help": f"{text} (default: {value})"} for name, (value, text) in COUNTS.items()},
    "passes": {"type": number_in(0.0), "default": 4.0, "help": "number of epochs (default: 4)"},
    "seconds": {"type": number_in(0.0), "default": 280.0, "help": "time limit of a training with its stream [s] (default: 280)"},
    "crop": {"type": number_in(0.1, 1.0), "default": Recipe.crop, "help": "side length of late crops, as a fraction (default: 0.5)"},
    "first-seed": {"type": int, "default": 0, "help": "first seed (default: 0)"},
    "cameras": {"type": int, "nargs": "+", "help": "indices of the cameras to train on (default: all)"},
    "name": {"default": "real", "help": "name of the run, in files (default: real)"},
    "pictures": {"type": existing_folder, "metavar": "DIR", "help": "write overlays of all frames to this folder"},
}
"""Options of this report; see `tools.options.OPTIONS`."""


@dataclass(frozen=True, eq=False)
class TrainingOutcome:
    """Result of one seed: trained network, scores on photographs and on held-out synthetic views."""

    trained: Trained
    real: NetworkScores
    synthetic: NetworkScores
    overlay: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    """Colour image (H, W, 3) uint8, true and predicted obj_ids (H, W) uint8 of each frame."""


def check_ids(labels: list[np.ndarray]) -> None:
    """Check that the networks have a class for each object of label images.

    Raises:
        ConfigError: An obj_id is larger than MODELS.
    """
    largest = max(int(label.max(initial=0)) for label in labels)
    if largest > MODELS:
        raise ConfigError(f"an object has obj_id {largest}; allowed here: 1 to {MODELS}, those of YCB-Video")


def recipe_of(options: argparse.Namespace) -> Recipe:
    """Hyper-parameters of a command line."""
    return Recipe(**{name: value for name, value in vars(options).items() if name in Recipe.__dataclass_fields__})


def source_of(options: argparse.Namespace, seed: int, device: Any) -> ViewSource:
    """Source of the training views of a seed.

    Raises:
        ConfigError: A setting is wrong.
    """
    fixed: dict[str, object] = {"bake.worlds": options.worlds, "bake.seed": options.seed + 1000 * seed}
    fixed |= {"render.views_per_batch": VIEWS_PER_BATCH, "bake.device": device.alias}
    config = configure(options, fixed)
    if options.enlarge > 1:
        sizes = [(options.enlarge * width, options.enlarge * height) for width, height in config.rig.sizes]
        config = replace(config, camera=tuple(map(resized, config.rig.rows, sizes)))
    for width, height in config.rig.sizes:
        if width % (2 * BLOCK) or height % (2 * BLOCK):
            raise ConfigError(f"images of {width}x{height} px cannot be augmented by JPEG; use multiples of {2 * BLOCK}")
    return ViewSource(config, TRAINING, options.stride, tuple(options.cameras or ()) or None)


def measure(trained: Trained, frames: list[RealFrame], held: ViewPool, device: torch.device) -> TrainingOutcome:
    """Scores of a network on real frames, which it sees at the size of the held-out views, and on these."""
    height, width = held.tensors()[0].shape[2:]
    found = [predict(trained.network, frame.color, (int(width), int(height)), device) for frame in frames]
    real = score([(frame.name, one, frame.label) for frame, one in zip(frames, found, strict=True)], 1 + MODELS)
    overlay = [(frame.color, frame.label, one) for frame, one in zip(frames, found, strict=True)]
    return TrainingOutcome(trained, real, score_pool(trained.network, held, 1 + MODELS), overlay)


def interval(values: Sequence[float]) -> str:
    """95 % confidence interval of the mean over seeds (Student's t), formatted; two values are listed, one gives an empty string."""
    if len(values) < 3:
        return f"({values[0]:.3g}, {values[1]:.3g})" if len(values) == 2 else ""
    reach = float(stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return f"({np.mean(values) - reach:.3g} to {np.mean(values) + reach:.3g})"


def rows_of(outcomes: list[TrainingOutcome]) -> list[MeasuredRow]:
    """Rows of the report: means over seeds, for all frames, by object and by frame."""

    def row(name: str, values: list[float], unit: str = "", part: str = "") -> MeasuredRow:
        return MeasuredRow(name, round(float(np.mean(values)), 4), " ".join(one for one in (unit, interval(values)) if one), part=part)

    rows = []
    for where, scores in (("real frames", [one.real for one in outcomes]), ("synthetic, held out", [one.synthetic for one in outcomes])):
        rows += [
            row(f"{where}: mIoU", [one.mean_iou for one in scores]),
            row(f"{where}: instances with IoU above 0.5", [100 * one.found for one in scores], "%"),
            row(f"{where}: background taken for objects", [100 * one.background for one in scores], "%"),
        ]
    rows += [
        row("training, in all", [one.trained.seconds for one in outcomes], "s"),
        row("of it the stream", [one.trained.stream_seconds for one in outcomes], "s"),
        row("views", [float(one.trained.views) for one in outcomes]),
        row("loss at the end", [one.trained.losses[-1] for one in outcomes]),
    ]
    first = outcomes[0].real
    rows += [row(f"obj_id {index}: IoU", [one.real.iou[index] for one in outcomes], part="object") for index in first.iou]
    return rows + [row(f"{name}: mean IoU", [one.real.views[name] for one in outcomes], part="frame") for name in first.views]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = make_options().parse_args(arguments)
    try:
        frames, device = read_frames(options.real), pick_device(options.device)
        # Work on CUDA's default stream would wait for all that the renderer has queued.
        with torch.cuda.stream(torch.cuda.Stream(device.alias) if device.is_cuda else None):
            run(options, frames, device)
    except SynpickError as error:
        return fail("reports.real", error)
    return 0


def run(options: argparse.Namespace, frames: list[RealFrame], device: Any) -> None:
    """Train and score with all seeds of a command line; results are written after each, and printed.

    Raises:
        SynpickError: A setting is wrong, models or lights cannot be used, or files cannot be written.
    """
    source = source_of(options, 0, device)
    few = replace(source.config, bake=replace(source.config.bake, worlds=min(options.worlds, FEW_WORLDS)))
    held = hold_out(replace(source, config=few, episodes=HELD_OUT, cameras=None), options.held_out)
    check_ids([*(frame.label for frame in frames), held.tensors()[1].cpu().numpy()])
    target, outcomes = torch.device(device.alias), list[TrainingOutcome]()
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        trained = train(source_of(options, seed, device), recipe_of(options), 1 + MODELS, target, seed)
        outcomes.append(measure(trained, frames, held, target))
        print(_line(seed, outcomes[-1]), flush=True)
        write_run(options.json, describe_run("tools.reports.real", (), rows_of(outcomes), name=options.name, seeds=by_seed(outcomes)))
        if options.pictures is not None:
            draw_overlay(options.pictures / f"{options.name}_seed_{seed}.png", outcomes[-1].overlay, 1 + MODELS)
    print_rows(Console(), "", "photographs", rows_of(outcomes))


def _line(seed: int, outcome: TrainingOutcome) -> str:
    """Summary of a seed, as a line."""
    trained, real = outcome.trained, outcome.real
    return (
        f"seed {seed}: {trained.views} views, {trained.samples} samples, {trained.seconds:.1f} s (stream {trained.stream_seconds:.1f}); "
        f"loss {trained.losses[0]:.3f} to {trained.losses[-1]:.3f}; mIoU {real.mean_iou:.3f} (synthetic "
        f"{outcome.synthetic.mean_iou:.3f}), found {100 * real.found:.0f} %, background {100 * real.background:.1f} %"
    )


def by_seed(outcomes: list[TrainingOutcome]) -> list[dict[str, Any]]:
    """Scores and facts of each seed, for JSON."""
    real = [{name: getattr(one.real, name) for name in ("mean_iou", "found", "background", "instances")} for one in outcomes]
    facts = ("losses", "seconds", "stream_seconds", "views", "samples")
    return [
        scores | {"synthetic_mean_iou": one.synthetic.mean_iou} | {name: getattr(one.trained, name) for name in facts}
        for scores, one in zip(real, outcomes, strict=True)
    ]


def make_options() -> argparse.ArgumentParser:
    """Parser of the command line."""
    parser = make_parser(__doc__, "config", "device", "models", "lights", "seed", "set", "json", own=OWN, config=PRESET)
    parser.add_argument("--real", type=Path, required=True, help="folder of annotated frames, as tools.reports.real_frames reads them")
    return parser


if __name__ == "__main__":
    sys.exit(main())
