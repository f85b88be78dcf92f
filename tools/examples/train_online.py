"""Train a small segmentation network from the stream, without files, and print its held-out mIoU for several amounts of data.

The network names each pixel's object. For each amount it is trained anew, on views that come once; the held-out views are of other
episodes. Needs PyTorch; the defaults are for a GPU.

    python -m tools.examples.train_online --device cuda:0 --worlds 64 --models MODELS --lights LIGHTS --views 2000,8000,32000
"""

import argparse
import itertools
import math
import sys
import time

from synpick_warp.online.stream import ViewStream

try:
    import torch  # pyright: ignore[reportMissingImports]
    from torch import nn  # pyright: ignore[reportMissingImports]
    from torch.nn import functional  # pyright: ignore[reportMissingImports]
except ModuleNotFoundError as missing:
    raise SystemExit(f"train_online: {missing.name} is not installed; pip install torch") from None

import synpick_warp
from synpick_warp.cli.options import parse_resolution
from synpick_warp.errors import ConfigError, SynpickError
from synpick_warp.online.dataset import FIELDS, StreamDataset
from synpick_warp.system.hardware.device import pick_device
from tools.options import configure, counts, fail, make_parser, positive_count

TRAINING, HELD_OUT = range(100_000), range(100_000, 101_000)
"""Episodes to train on, and to measure on."""
HELD_OUT_STRIDE = 20
"""Stride of the measured frames of a held-out episode: 1.3 s."""
LEARNING_RATE = 2e-3
MIN_SIDE = 8
"""Least width and height of an image [px]: it is halved three times."""
WARM_UP, LEAST_RATE = 0.1, 0.01
"""Fraction of a training in which the learning rate rises; fraction of the rate to which it falls afterwards, as a cosine."""


class Network(nn.Module):
    """U-Net: four levels of two convolutions each, with `width` to 8 x `width` channels."""

    def __init__(self, classes: int, width: int, inputs: int = 3) -> None:
        super().__init__()
        widths = [width * factor for factor in (1, 2, 4, 8)]
        self.down = nn.ModuleList(_convolutions(before, after) for before, after in itertools.pairwise((inputs, *widths)))
        self.up = nn.ModuleList(_convolutions(low + high, high) for high, low in itertools.pairwise(widths))
        self.head = nn.Conv2d(width, classes, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Logits (B, classes, H, W) of an image (B, inputs, H, W): uint8, or float32 as it is."""
        x, skips = image.float().div(255).sub(0.5) if image.dtype == torch.uint8 else image, []
        for level in self.down:
            x = level(functional.max_pool2d(x, 2) if skips else x)
            skips.append(x)
        for level, skip in zip(reversed(self.up), reversed(skips[:-1]), strict=True):
            x = level(torch.cat((self.upsample(x, skip.shape[2:]), skip), dim=1))
        return self.head(x)

    @staticmethod
    def upsample(x: torch.Tensor, size: torch.Size) -> torch.Tensor:
        """Bilinear interpolation of features (B, C, H, W) to a height and width of `size`."""
        return functional.interpolate(x, size=size, mode="bilinear", align_corners=False)


def _convolutions(before: int, after: int) -> nn.Sequential:
    """Two 3 x 3 convolutions with batch normalization and ReLU, from `before` to `after` channels."""
    pairs = [(nn.Conv2d(count, after, 3, padding=1, bias=False), nn.BatchNorm2d(after), nn.ReLU()) for count in (before, after)]
    return nn.Sequential(*itertools.chain.from_iterable(pairs))


def hold_out(stream: ViewStream, views: int) -> tuple[list[dict[str, torch.Tensor]], int]:
    """Copies of `views` views or a few more of a stream, in batches; and the number of classes, 0 for no object."""
    batches, count = [], 0
    while count < views:
        batch = next(stream, None)
        if batch is None:
            raise ConfigError(f"--held-out is {views}, but {len(HELD_OUT)} episodes have {count} views; name fewer")
        batches.append({name: FIELDS[name](batch).clone() for name in ("rgb", "classes")})
        count += len(batch)
    return batches, 1 + max(stream.object_names)


def schedule(done: float, warm_up: float = WARM_UP) -> float:
    """Factor of the learning rate when the fraction `done` of a training has passed."""
    factor = done / warm_up if done < warm_up else 0.5 + 0.5 * math.cos(math.pi * min(1.0, (done - warm_up) / (1 - warm_up)))
    return max(factor, LEAST_RATE)


def train(dataset: StreamDataset, views: int, classes: int, width: int, device: torch.device) -> tuple[Network, list[float]]:
    """Train a new network on at least `views` views, in whole batches; returns the network and the loss of each batch."""
    torch.manual_seed(dataset.config.bake.seed)
    network = Network(classes, width).to(device)
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE)
    losses, seen = [], 0
    for batch in torch.utils.data.DataLoader(dataset, batch_size=None):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * schedule(seen / views)
        loss = functional.cross_entropy(network(batch["rgb"]), batch["classes"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
        seen += len(batch["rgb"])
        if seen >= views:
            break
    return network, torch.stack(losses).tolist()


def mean_iou(network: Network, batches: list[dict[str, torch.Tensor]], classes: int) -> float:
    """Intersection over union of each object's pixels in all views, averaged over the objects that occur."""
    network.eval()
    counts = torch.zeros(classes * classes, dtype=torch.int64, device=batches[0]["rgb"].device)
    with torch.no_grad():
        for batch in batches:
            pairs = batch["classes"] * classes + network(batch["rgb"]).argmax(dim=1)
            counts += torch.bincount(pairs.flatten(), minlength=classes * classes)
    table = counts.view(classes, classes).double().cpu()
    union = table.sum(0) + table.sum(1) - table.diagonal()
    occurs = table.sum(1) > 0
    occurs[0] = False  # What is no object.
    return float((table.diagonal() / union.clamp(min=1))[occurs].mean())


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = parse(arguments)
    try:
        device = pick_device(options.device)
        run(options, torch.device(device.alias))
    except SynpickError as error:
        return fail("train_online", error)
    return 0


def run(options: argparse.Namespace, device: torch.device) -> list[float]:
    """Train and measure for each amount; returns mIoU. Raises SynpickError: a setting is wrong, or models or lights cannot be used."""
    fixed = {"bake.worlds": options.worlds, "cameras.resolution": parse_resolution(options.resolution)}
    config = configure(options, fixed, {"bake.mode": "mixed", "render.views_per_batch": options.batch})
    if min(config.cameras.resolution) < MIN_SIDE:
        raise ConfigError(
            f"--resolution is {options.resolution}; allowed: at least {MIN_SIDE} px on each side, for the network's four levels"
        )
    results = []
    # A stream of its own: work on CUDA's default stream would wait for all that the renderer has queued.
    with torch.cuda.stream(torch.cuda.Stream(device) if device.type == "cuda" else None):
        # Nobody trains on these episodes.
        with synpick_warp.stream(config, episodes=HELD_OUT, stride=HELD_OUT_STRIDE) as stream:
            batches, classes = hold_out(stream, options.held_out)
        print(f"held out: {sum(len(batch['rgb']) for batch in batches)} views, obj_id up to {classes - 1}")
        for views in options.views:
            started = time.perf_counter()
            dataset = StreamDataset(config, fields=("rgb", "classes"), episodes=TRAINING, stride=options.stride)
            network, losses = train(dataset, views, classes, options.width, device)
            seconds = time.perf_counter() - started
            results.append(mean_iou(network, batches, classes))
            tail = losses[-max(1, len(losses) // 10) :]
            print(f"{views} views in {seconds:.1f} s: cross entropy {losses[0]:.3f} to {sum(tail) / len(tail):.3f}, mIoU {results[-1]:.3f}")
    return results


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser(__doc__, "device", "models", "lights", "seed", "set")
    parser.add_argument("--worlds", type=positive_count, default=64, help="worlds simulated in parallel (default: 64)")
    parser.add_argument("--resolution", default="320x180", help="WIDTHxHEIGHT [px] (default: 320x180)")
    parser.add_argument("--batch", type=positive_count, default=24, help="views of a batch, at most (default: 24)")
    parser.add_argument("--stride", type=positive_count, default=3, help="every n-th frame is trained on (default: 3)")
    parser.add_argument("--width", type=positive_count, default=32, help="channels of the network's first level (default: 32)")
    parser.add_argument("--held-out", type=positive_count, default=600, help="views to measure on (default: 600)")
    amounts = "views to train on, a network for each number, comma-separated (default: 2000,8000,32000)"
    parser.add_argument("--views", type=counts, default=(2000, 8000, 32000), help=amounts)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
