"""Sim-to-real semantic segmentation: trains on synthetic views only, evaluates on annotated photographs (mIoU, recall, background).

Each seed has its own piles, pictures and network; values are means over seeds with 95 % intervals. The same held-out synthetic views are
evaluated for all seeds, for comparison. Needs PyTorch; the defaults are for a GPU.

    python -m tools.reports.real --real REAL --models YCB --lights HDRI --seeds 3 --json real.json --pictures OUT

IoU is over the pixels of all views (PASCAL VOC; Everingham et al., 2010). Each class is there once in a view, so an instance is the pixels
of its class. Predictions are those of the network at its own size; logits are upsampled to the size of the labels.
"""

import argparse
import sys
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

try:
    import torch  # pyright: ignore[reportMissingImports]
    from torch import nn  # pyright: ignore[reportMissingImports]

    from tools.reports.real.training import BLOCK, Recipe, Trained, ViewPool, train, upsample
except ModuleNotFoundError as missing:
    raise SystemExit(f"reports.real: {missing.name} is not installed; pip install torch") from None

from rich.console import Console
from scipy import stats

from synpick_warp.configs.cell.cameras import resized
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError, SynpickError
from synpick_warp.online.dataset import StreamDataset
from synpick_warp.system.hardware.device import pick_device
from tools.figures import describe_run, write_run
from tools.options import MeasuredRow, configure, existing_folder, fail, finite_amount, make_parser, positive_count, print_rows
from tools.reports.real.frames import RealFrame, read_frames, render_frames

TRAINING, HELD_OUT = range(1_000_000), range(1_000_000, 1_100_000)
"""Episodes to train on, and to measure on."""
HELD_OUT_VIEWS, FEW_WORLDS = 400, 64
"""Synthetic views to measure on, and maximum number of worlds for them."""
PRESET = "tabletop-train"
"""Default preset of the stream."""
VIEWS_PER_BATCH = 48
"""Views that are rendered together: more than a batch of the training, so that the GPU is busy."""
STRIDE, ENLARGE = 2, 2
"""Every n-th frame of an episode is trained on, at n times the resolution of the preset, which is that of the photographs."""
MODELS = 21
"""Largest obj_id: networks have a class for each, and class 0 for pixels without object."""
FOUND_IOU = 0.5
"""IoU above which an instance counts as found."""
MIN_PIXELS = 20
"""Pixels of the network's image below which an instance of a synthetic view is not counted."""
SCORED = 16
"""Views of a pool that are scored together."""
OVERLAY_WIDTH = 240
"""Width of a view in the contact sheet [px]."""
COUNTS = {
    "views": (24_000, "views of the stream"),
    "seeds": (3, "trainings, each with piles of its own"),
    "worlds": (512, "worlds simulated in parallel"),
    "capacity": (24_000, "views in the pool, at most"),
    "batch": (48, "views of a batch"),
}
"""Options that are integers above 0: default and meaning."""
OWN = {
    **{name: {"type": positive_count, "default": value, "help": f"{text} (default: {value})"} for name, (value, text) in COUNTS.items()},
    "passes": {"type": finite_amount, "default": 40.0, "help": "number of epochs, if time allows (default: 40)"},
    "seconds": {"type": finite_amount, "default": 280.0, "help": "time limit of a training with its stream [s] (default: 280)"},
    "pictures": {"type": existing_folder, "metavar": "DIR", "help": "write overlays of all frames to this folder"},
}
"""Options of this report; see `tools.options.OPTIONS`."""

Batches = Generator[tuple[torch.Tensor, torch.Tensor]]
Labelled = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Colour image (H, W, 3) uint8, true and predicted obj_ids (H, W) uint8."""


# ---- scores ----


@dataclass(frozen=True, eq=False)
class NetworkScores:
    """Scores of a network on annotated views."""

    iou: dict[int, float]
    """IoU over all views of each object that occurs, by obj_id."""
    instances: list[float]
    """IoU of each instance."""
    background: float
    """Share of the background's pixels that are taken for objects."""

    @property
    def mean_iou(self) -> float:
        """IoU averaged over the objects that occur."""
        return float(np.mean(list(self.iou.values()))) if self.iou else float("nan")

    @property
    def found(self) -> float:
        """Share of instances with an IoU above FOUND_IOU."""
        return float(np.mean(np.array(self.instances) > FOUND_IOU)) if self.instances else float("nan")


def predict(network: nn.Module, color: np.ndarray, size: tuple[int, int], device: torch.device) -> np.ndarray:
    """Segmentation of an image (H, W, 3) uint8, which the network sees at `size` (width, height): obj_id of each pixel (H, W) uint8."""
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    image = torch.from_numpy(np.ascontiguousarray(small.transpose(2, 0, 1)))[None]
    with torch.no_grad():
        logits = upsample(network(image.to(device)).float(), color.shape[:2])
    return logits[0].argmax(0).to(torch.uint8).cpu().numpy()


def score(predictions: Iterable[tuple[np.ndarray, np.ndarray]], classes: int, least: int = 1) -> NetworkScores:
    """Scores of predictions: predicted and true obj_ids (H, W) uint8; `least`: pixels of an instance that counts."""
    total, instances = np.zeros((classes, classes), np.int64), list[float]()
    for found, truth in predictions:
        table = np.bincount(truth.astype(np.int64).ravel() * classes + found.ravel(), minlength=classes**2).reshape(classes, classes)
        total += table
        instances += _ious(table)[1:][table.sum(axis=1)[1:] >= least].tolist()
    ious, occurs = _ious(total), total.sum(axis=1) > 0
    background = float(total[0, 1:].sum() / max(1, total[0].sum()))
    return NetworkScores({index: float(ious[index]) for index in range(1, classes) if occurs[index]}, instances, background)


def _ious(table: np.ndarray) -> np.ndarray:
    """IoU of each class of a confusion table (truth, prediction)."""
    union = table.sum(0) + table.sum(1) - table.diagonal()
    return table.diagonal() / np.maximum(union, 1)


def score_pool(network: nn.Module, pool: ViewPool, classes: int) -> NetworkScores:
    """Scores of a network on the views of a pool, at their own size."""

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for images, truth in zip(*(values[: pool.count].split(SCORED) for values in pool.tensors()), strict=True):
            with torch.no_grad():
                found = network(images).argmax(1)
            yield from zip(found.to(torch.uint8).cpu().numpy(), truth.cpu().numpy(), strict=True)

    return score(pairs(), classes, MIN_PIXELS)


def draw_overlay(path: Path, rows: Sequence[Labelled], classes: int) -> None:
    """Write a contact sheet (PNG) with a column for each view: image, and truth and prediction laid over it, in a hue for each obj_id."""
    index, columns = np.arange(classes), []
    hues = np.stack([index * 67 % 180, np.full(classes, 220), np.where(index % 2, 255, 190)], axis=-1).astype(np.uint8)
    palette = cv2.cvtColor(hues[None], cv2.COLOR_HSV2RGB)[0]
    palette[0] = 0
    for color, truth, found in rows:
        height = round(color.shape[0] * OVERLAY_WIDTH / color.shape[1])
        layers = [color, *(cv2.addWeighted(color, 0.45, palette[ids], 0.55, 0) for ids in (truth, found))]
        columns.append(np.vstack([cv2.resize(layer, (OVERLAY_WIDTH, height), interpolation=cv2.INTER_AREA) for layer in layers]))
    cv2.imwrite(str(path), np.hstack(columns)[..., ::-1])


# ---- runs ----


@dataclass(frozen=True, eq=False)
class TrainingOutcome:
    """Result of one seed: trained network, scores on photographs and on held-out synthetic views."""

    trained: Trained
    real: NetworkScores
    twins: NetworkScores
    """Scores on the photographs with rendered objects: what they lack of `real` is due to the objects' appearance."""
    synthetic: NetworkScores
    overlay: list[Labelled]


def check_ids(labels: list[np.ndarray]) -> None:
    """Check that the networks have a class for each object of label images. Raises ConfigError: an obj_id is larger than MODELS."""
    largest = max(int(label.max(initial=0)) for label in labels)
    if largest > MODELS:
        raise ConfigError(f"an object has obj_id {largest}; allowed here: 1 to {MODELS}, those of YCB-Video")


def settings_of(options: argparse.Namespace, seed: int, device: Any) -> Config:
    """Settings of the stream of a seed. Raises ConfigError: a setting is wrong."""
    fixed: dict[str, object] = {"bake.worlds": options.worlds, "bake.seed": options.seed + 1000 * seed}
    fixed |= {"render.views_per_batch": VIEWS_PER_BATCH, "bake.device": device.alias}
    config = configure(options, fixed)
    sizes = [(ENLARGE * width, ENLARGE * height) for width, height in config.rig.sizes]
    for width, height in sizes:
        if width % (2 * BLOCK) or height % (2 * BLOCK):
            raise ConfigError(f"images of {width}x{height} px cannot be augmented by JPEG; use multiples of {2 * BLOCK}")
    return replace(config, camera=tuple(map(resized, config.rig.rows, sizes)))


def stream_views(config: Config, episodes: range, views: int) -> Batches:
    """Images (B, 3, H, W) and obj_ids (B, H, W) uint8 of `views` views of a stream; a batch is valid until the next one."""
    dataset = StreamDataset(config, fields=("rgb", "classes"), episodes=episodes, stride=STRIDE)
    for batch in torch.utils.data.DataLoader(dataset, batch_size=None):
        yield batch["rgb"][:views], batch["classes"][:views].to(torch.uint8)
        views -= len(batch["rgb"])
        if views <= 0:
            return


def measure(trained: Trained, frames: list[RealFrame], twins: list[RealFrame], held: ViewPool, device: torch.device) -> TrainingOutcome:
    """Score a network on real frames and their twins, resized for it to the size of the held-out views, and on those views."""
    height, width = held.tensors()[0].shape[2:]
    overlays = [
        [(frame.color, frame.label, predict(trained.network, frame.color, (int(width), int(height)), device)) for frame in part]
        for part in (frames, twins)
    ]
    real, paired = (score([(found, truth) for _, truth, found in overlay], 1 + MODELS) for overlay in overlays)
    return TrainingOutcome(trained, real, paired, score_pool(trained.network, held, 1 + MODELS), overlays[0])


def interval(values: Sequence[float]) -> str:
    """95 % confidence interval of the mean over seeds (Student's t), formatted; two values are listed, one gives an empty string."""
    if len(values) < 3:
        return f"({values[0]:.3g}, {values[1]:.3g})" if len(values) == 2 else ""
    reach = float(stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return f"({np.mean(values) - reach:.3g} to {np.mean(values) + reach:.3g})"


def rows_of(outcomes: list[TrainingOutcome]) -> list[MeasuredRow]:
    """Rows of the report: means over seeds, for all frames and by object."""

    def row(name: str, values: list[float], unit: str = "", part: str = "") -> MeasuredRow:
        return MeasuredRow(name, round(float(np.mean(values)), 4), " ".join(one for one in (unit, interval(values)) if one), part=part)

    rows = []
    for where, kind in (("real frames", "real"), ("twins of these", "twins"), ("synthetic, held out", "synthetic")):
        scores = [getattr(one, kind) for one in outcomes]
        rows += [
            row(f"{where}: mIoU", [one.mean_iou for one in scores]),
            row(f"{where}: instances with IoU above 0.5", [100 * one.found for one in scores], "%"),
            row(f"{where}: background taken for objects", [100 * one.background for one in scores], "%"),
        ]
    rows += [
        row("training, in all", [one.trained.seconds for one in outcomes], "s"),
        row("of it the stream", [one.trained.stream_seconds for one in outcomes], "s"),
        row("views", [float(one.trained.views) for one in outcomes]),
        row("samples", [float(one.trained.samples) for one in outcomes]),
        row("loss at the end", [one.trained.losses[-1] for one in outcomes]),
    ]
    return rows + [row(f"obj_id {index}: IoU", [one.real.iou[index] for one in outcomes], part="object") for index in outcomes[0].real.iou]


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
    """Train and score with all seeds of a command line; results are written after each, and printed. Raises SynpickError: a setting is
    wrong, models or lights cannot be used, or files cannot be written."""
    config, twins = settings_of(options, 0, device), render_frames(frames, options)
    few, held = replace(config, bake=replace(config.bake, worlds=min(options.worlds, FEW_WORLDS))), ViewPool(HELD_OUT_VIEWS, 0)
    held.fill(stream_views(few, HELD_OUT, HELD_OUT_VIEWS), HELD_OUT_VIEWS)
    check_ids([*(frame.label for frame in frames), held.tensors()[1].cpu().numpy()])
    recipe = Recipe(**{name: value for name, value in vars(options).items() if name in Recipe.__dataclass_fields__})
    target, outcomes, rows = torch.device(device.alias), list[TrainingOutcome](), list[MeasuredRow]()
    for seed in range(options.seeds):
        views = stream_views(settings_of(options, seed, device), TRAINING, recipe.views)
        outcomes.append(measure(train(views, recipe, 1 + MODELS, target, options.seed + seed), frames, twins, held, target))
        rows, losses = rows_of(outcomes), [one.trained.losses for one in outcomes]
        write_run(options.json, describe_run("tools.reports.real", (), rows, losses=losses))
        print(f"seed {seed}:", *(f"{row.name} {row.value:.4g} {row.unit};" for row in rows_of(outcomes[-1:]) if not row.part), flush=True)
        if options.pictures is not None:
            draw_overlay(options.pictures / f"real_seed_{seed}.png", outcomes[-1].overlay, 1 + MODELS)
    print_rows(Console(), "", "photographs", rows)


def make_options() -> argparse.ArgumentParser:
    """Parser of the command line."""
    parser = make_parser(__doc__, "config", "device", "models", "lights", "seed", "set", "json", own=OWN, config=PRESET)
    parser.add_argument("--real", type=Path, required=True, help="frames: SSSS_FFFFFF-{color,depth,label}.png and -poses.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
