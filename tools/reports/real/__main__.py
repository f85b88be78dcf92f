"""Sim-to-real semantic segmentation: trains on synthetic views only, evaluates on annotated photographs (mIoU, recall, background).

Each seed has its own piles, pictures and network; values are means over seeds with 95 % intervals. The same held-out synthetic views are
evaluated for all seeds, for comparison. Needs PyTorch; the defaults are for a GPU.

    python -m tools.reports.real --real REAL --models YCB --lights HDRI --views 24000 --seeds 3 --json real.json --pictures OUT
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch  # pyright: ignore[reportMissingImports]

    from tools.reports.real.detector import average_precision, boxes_of, detect, train_detector
    from tools.reports.real.networks import NETWORKS
    from tools.reports.real.scores import Scores, draw_overlay, predict, score, score_pool
    from tools.reports.real.training import BLOCK, Recipe, Trained, train
    from tools.reports.real.views import Pool, Source, hold_out
except ModuleNotFoundError as missing:
    raise SystemExit(f"reports.real: {missing.name} is not installed; pip install torch") from None

from rich.console import Console

from synpick_warp.configs.cell.rig import resized
from synpick_warp.dataset.view import MILLIMETERS
from synpick_warp.errors import ConfigError, SynpickError
from synpick_warp.system.hardware.device import pick_device
from tools.figures import describe_run
from tools.options import Row, configure, fail, make_parser, number_in, positive_count, print_rows, write_json
from tools.reports.real import OBJECT, interval
from tools.reports.real_frames import DEPTH_SCALE, RealFrame, copy_frames, read_frames

TRAINING, HELD_OUT = range(1_000_000), range(1_000_000, 1_100_000)
"""Episodes to train on, and to measure on."""
FEW_WORLDS = 64
"""Maximum number of worlds for held-out views."""
PRESET = "tabletop-train"
"""Default preset of the stream."""
VIEWS_PER_BATCH = 48
"""Views that are rendered together: more than a batch of the training, so that the GPU is busy."""
_FRACTION = number_in(0.0, 1.0)
RANGES = {
    "scale": number_in(1.0, 4.0),
    "jpeg": number_in(0.0, 100.0),
    "half": _FRACTION,
    "crop": number_in(0.1, 1.0),
}
"""Argument types of the options that are not just non-negative numbers."""
MODELS = 21
"""Largest obj_id: networks have a class for each, and class 0 for pixels without object."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of one seed: trained network, scores on photographs and on held-out synthetic views."""

    trained: Trained
    real: Scores
    synthetic: Scores
    overlay: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    """Colour image (H, W, 3) uint8, true and predicted obj_ids (H, W) uint8 of each frame."""
    precision: float = float("nan")
    """AP at an IoU of 0.5 of the detector; NaN: none was trained."""


@dataclass(frozen=True, eq=False)
class Bench:
    """What all runs of a process share: photographs, held-out views with depth, and the device."""

    frames: list[RealFrame]
    held: Pool
    device: Any

    @property
    def target(self) -> torch.device:
        """The device for PyTorch."""
        return torch.device(self.device.alias)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the views [px]."""
        height, width = self.held.tensors()[0].shape[2:]
        return int(width), int(height)


@contextmanager
def open_bench(options: argparse.Namespace) -> Iterator[Bench]:
    """Read the photographs and hold out views of the settings of `options`; within, PyTorch works on a stream of its own.

    Raises:
        SynpickError: A setting is wrong, or photographs, models or lights cannot be used.
    """
    frames, device = read_frames(options.real), pick_device(options.device)
    # Work on CUDA's default stream would wait for all that the renderer has queued.
    with torch.cuda.stream(torch.cuda.Stream(device.alias) if device.is_cuda else None):
        source = source_of(options, 0, device)
        few = replace(source.config, bake=replace(source.config.bake, worlds=min(options.worlds, FEW_WORLDS)))
        held = hold_out(replace(source, config=few, episodes=HELD_OUT, cameras=None, depth=True), options.held_out)
        check_ids([*(frame.label for frame in frames), held.tensors()[1].cpu().numpy()])
        yield Bench(frames, held, device)


def check_ids(labels: list[np.ndarray]) -> None:
    """Check that the networks have a class for each object of label images.

    Raises:
        ConfigError: An obj_id is larger than MODELS.
    """
    largest = max(int(label.max(initial=0)) for label in labels)
    if largest > MODELS:
        raise ConfigError(f"an object has obj_id {largest}; allowed here: 1 to {MODELS}, those of YCB-Video")


def run_seed(options: argparse.Namespace, seed: int, bench: Bench) -> Iterator[Outcome]:
    """Train and score with one seed; with --detector, the outcome comes again with its precision.

    Raises:
        SynpickError: A setting is wrong, or models or lights cannot be used.
    """
    trained, pool = train(source_of(options, seed, bench.device), recipe_of(options), 1 + MODELS, bench.target, seed)
    outcome = measure(trained, options.depth, bench)
    yield outcome
    if options.detector:
        yield replace(outcome, precision=_detector(options, pool, bench))


def recipe_of(options: argparse.Namespace) -> Recipe:
    """Hyper-parameters of a command line."""
    return Recipe(**{name: getattr(options, name) for name in Recipe.__dataclass_fields__})


def measure(trained: Trained, depth: bool, bench: Bench) -> Outcome:
    """Scores of a network, which sees colour or colour and depth, on real frames and on held-out views."""
    depths = [frame.depth * DEPTH_SCALE / MILLIMETERS if depth else None for frame in bench.frames]
    shown = zip(bench.frames, depths, strict=True)
    found = [predict(trained.network, frame.color, bench.size, bench.target, measured) for frame, measured in shown]
    real = score([(frame.name, one, frame.label) for frame, one in zip(bench.frames, found, strict=True)], 1 + MODELS)
    overlay = [(frame.color, frame.label, one) for frame, one in zip(bench.frames, found, strict=True)]
    return Outcome(trained, real, score_pool(trained.network, bench.held, 1 + MODELS, 3 + depth), overlay)


def source_of(options: argparse.Namespace, seed: int, device: Any) -> Source:
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
        if options.jpeg and (width % (2 * BLOCK) or height % (2 * BLOCK)):
            raise ConfigError(f"images of {width}x{height} px cannot be augmented by JPEG; use multiples of {2 * BLOCK}, or --jpeg 0")
    return Source(config, TRAINING, options.stride, tuple(options.cameras or ()) or None, options.depth)


def _detector(options: argparse.Namespace, pool: Pool, bench: Bench) -> float:
    """AP at an IoU of 0.5 of a detector on real frames; NaN without torchvision, which is printed."""
    network = train_detector(pool, 1 + MODELS, bench.target, options.detector)
    if network is None:
        print("detector: torchvision is not installed or does not load; left out")
        return float("nan")
    found = [detect(network, frame.color, bench.size, bench.target) for frame in bench.frames]
    truth = [boxes_of(torch.from_numpy(frame.label)[None], 1 + MODELS)[0] for frame in bench.frames]
    return average_precision(found, [(boxes.numpy(), ids.numpy()) for boxes, ids in truth])


def rows_of(outcomes: list[Outcome]) -> list[Row]:
    """Rows of the report: means over seeds, for all frames, by object and by frame."""

    def row(name: str, values: list[float], unit: str = "", part: str = "") -> Row:
        return Row(name, round(float(np.mean(values)), 4), " ".join(one for one in (unit, interval(values)) if one), part=part)

    rows = [
        row("real frames: mIoU", [one.real.mean_iou for one in outcomes]),
        row("real frames: instances with IoU above 0.5", [100 * one.real.found for one in outcomes], "%"),
        row("real frames: background taken for objects", [100 * one.real.background for one in outcomes], "%"),
        row("synthetic, held out: mIoU", [one.synthetic.mean_iou for one in outcomes]),
        row("synthetic, held out: instances with IoU above 0.5", [100 * one.synthetic.found for one in outcomes], "%"),
        row("synthetic, held out: background taken for objects", [100 * one.synthetic.background for one in outcomes], "%"),
    ]
    precisions = [one.precision for one in outcomes if np.isfinite(one.precision)]
    rows += [row("real frames: AP50 of the detector", precisions)] if precisions else []
    rows += [
        row("training, in all", [one.trained.seconds for one in outcomes], "s"),
        row("of it the stream", [one.trained.stream_seconds for one in outcomes], "s"),
        row("compilation of kernels, before", [one.trained.compile_seconds for one in outcomes], "s"),
        row("views", [float(one.trained.views) for one in outcomes]),
        row("loss at the end", [one.trained.losses[-1] for one in outcomes]),
    ]
    first = outcomes[0].real
    rows += [row(f"obj_id {index}: IoU", [one.real.iou[index] for one in outcomes], part=OBJECT) for index in first.iou]
    return rows + [row(f"{name}: mean IoU", [one.real.views[name] for one in outcomes], part="frame") for name in first.views]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = make_options().parse_args(arguments)
    try:
        if options.pictures is not None and not options.pictures.is_dir():
            raise ConfigError(f"--pictures is {options.pictures}; name a folder that exists")
        with open_bench(options) as bench:
            carry_out(options, bench)
    except SynpickError as error:
        return fail("reports.real", error)
    return 0


def carry_out(options: argparse.Namespace, bench: Bench) -> None:
    """Train and score with all seeds of a command line; results are written after each, and printed.

    Raises:
        SynpickError: A setting is wrong, models or lights cannot be used, or files cannot be written.
    """
    outcomes: list[Outcome] = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        results = run_seed(options, seed, bench)
        outcomes.append(next(results))
        print(_line(seed, outcomes[-1]), flush=True)
        _write(options, outcomes)
        if options.pictures is not None:
            stem = options.pictures / f"{options.name}_seed_{seed}"
            draw_overlay(stem.with_suffix(".png"), outcomes[-1].overlay, 1 + MODELS)
            predicted = [found for _, _, found in outcomes[-1].overlay]
            copy_frames(options.real, {frame.name: found for frame, found in zip(bench.frames, predicted, strict=True)}, stem)
        for outcomes[-1] in results:
            _write(options, outcomes)
    print_rows(Console(), "", "photographs", rows_of(outcomes))


def _line(seed: int, outcome: Outcome) -> str:
    """Summary of a seed, as a line."""
    trained, real = outcome.trained, outcome.real
    return (
        f"seed {seed}: {trained.views} views, {trained.samples} samples, {trained.seconds:.1f} s (stream {trained.stream_seconds:.1f}); "
        f"loss {trained.losses[0]:.3f} to {trained.losses[-1]:.3f}; mIoU {real.mean_iou:.3f} (synthetic "
        f"{outcome.synthetic.mean_iou:.3f}), found {100 * real.found:.0f} %, background {100 * real.background:.1f} %"
    )


def _write(options: argparse.Namespace, outcomes: list[Outcome]) -> None:
    """Write the finished seeds as JSON, atomically: a run that is killed leaves a whole file."""
    if options.json is None:
        return
    by_seed = [
        {
            "mean_iou": one.real.mean_iou,
            "found": one.real.found,
            "background": one.real.background,
            "synthetic_mean_iou": one.synthetic.mean_iou,
            "instances": one.real.instances,
            "losses": one.trained.losses,
            "seconds": one.trained.seconds,
            "stream_seconds": one.trained.stream_seconds,
            "compile_seconds": one.trained.compile_seconds,
            "views": one.trained.views,
            "samples": one.trained.samples,
            "limit": options.seconds,
            "ap50": one.precision if np.isfinite(one.precision) else None,
        }
        for one in outcomes
    ]
    part = options.json.with_name(f"{options.json.name}.part")
    write_json(part, describe_run("tools.reports.real", (), rows_of(outcomes), name=options.name, seeds=by_seed))
    part.replace(options.json)


def make_options(text: str | None = __doc__) -> argparse.ArgumentParser:
    """Parser of the command line, described by `text`."""
    parser = make_parser(text, "config", "device", "models", "lights", "seed", "set", "json", config=PRESET)
    parser.add_argument("--real", type=Path, required=True, help="folder of annotated frames, as tools.reports.real_frames reads them")
    counts = {
        "views": (24_000, "views of the stream"),
        "seeds": (3, "trainings, each with piles of its own"),
        "worlds": (512, "worlds simulated in parallel"),
        "batch": (16, "views of a batch"),
        "width": (48, "channels of the network's first level"),
        "stride": (2, "every n-th frame of an episode is taken"),
        "enlarge": (2, "factor by which the resolution of all cameras is enlarged"),
        "capacity": (24_000, "views in the pool, at most"),
        "held_out": (400, "synthetic views to measure on"),
    }
    for name, (default, text) in counts.items():
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=positive_count, default=default, help=f"{text} (default: {default})")
    numbers = {
        "passes": (4.0, "number of epochs"),
        "seconds": (280.0, "time limit of a training with its stream, of which the first views take at most half [s]"),
        "scale": (Recipe.scale, "largest factor of augmentation by size; 1: no geometric augmentation"),
        "rotation": (Recipe.rotation, "half width of augmentation by rotation [°]"),
        "jitter": (Recipe.jitter, "strength of photometric augmentation; 0: none"),
        "jpeg": (Recipe.jpeg, "lowest JPEG quality of augmentation; 0: none"),
        "dice": (Recipe.dice, "weight of the Dice loss beside the cross entropy"),
        "rate": (Recipe.rate, "largest learning rate"),
        "half": (Recipe.half, "fraction of the training until which images have half the size"),
        "crop": (Recipe.crop, "side length of random crops in the rest of the training, as a fraction of the image's; 1: whole images"),
        "detector": (0.0, "seconds to train a detector; 0: none"),
    }
    for name, (default, text) in numbers.items():
        parser.add_argument(f"--{name}", type=RANGES.get(name, number_in(0.0)), default=default, help=f"{text} (default: {default:g})")
    parser.add_argument("--cameras", type=int, nargs="+", help="indices of the cameras to train on (default: all)")
    parser.add_argument("--network", choices=tuple(NETWORKS), default=Recipe.network, help="network (default: unet)")
    parser.add_argument("--depth", action="store_true", help="train and measure on colour and depth")
    parser.add_argument("--compile", action="store_true", help="compile the training step, before the clock starts: 1.6 times as fast")
    parser.add_argument("--first-seed", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument("--name", default="real", help="name of the run, in files (default: real)")
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="write overlays of all frames to this folder, and the frames with predicted labels"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
