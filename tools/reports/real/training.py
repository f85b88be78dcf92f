"""Training of a segmentation network from a pool of views, with augmentation, by cross entropy and soft Dice.

AdamW with a warm-up and a cosine schedule, mixed precision (bfloat16) on a GPU. Augmentation is geometric (scale, rotation, shift, mirrored
borders) and photometric (gain, contrast, saturation, gamma, blur, noise, JPEG), each image by its own draw.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]
from torch.nn import functional  # pyright: ignore[reportMissingImports]

from synpick_warp.system.codecs.jpeg import QUALITIES, quantization, zigzag_order
from tools.examples.train_online import LEARNING_RATE, WARM_UP
from tools.reports.real.networks import NETWORKS
from tools.reports.real.views import Pool, Source

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in luma (ITU-R BT.601)."""
YCC = (LUMA, (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
"""Y, Cb and Cr of red, green and blue (JFIF)."""
BLOCK = 8
"""Side of a JPEG block [px]."""
LEAST_RATE = 0.01
"""Fraction of the learning rate at which the schedule ends."""
MAX_NORM = 5.0
"""Norm to which gradients are clipped."""
FILLING = 0.5
"""Largest fraction of the time limit that passes before the first step, while the stream fills the pool."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters, none of which is chosen on real pictures."""

    views: int
    """Views of the stream."""
    passes: float
    """Number of epochs."""
    batch: int
    width: int
    """Channels of the network's first level."""
    seconds: float
    """Time limit of rendering and training together [s], by which the schedule ends."""
    capacity: int
    """Views in the pool, at most."""
    scale: float = 1.5
    """Largest scale factor; the smallest is its reciprocal."""
    rotation: float = 15.0
    """Largest rotation in each direction [°]."""
    jitter: float = 0.3
    """Strength of the photometric augmentation; 0: none."""
    jpeg: float = 40.0
    """Lowest JPEG quality of the photometric augmentation; 0: no JPEG."""
    dice: float = 0.0
    """Weight of the Dice loss, which is added to the cross entropy."""
    rate: float = LEARNING_RATE
    """Peak learning rate of the schedule."""
    network: str = "unet"
    """Architecture: a key of NETWORKS."""
    depth: bool = False
    """Whether the network sees depth beside colours."""
    half: float = 0.0
    """Fraction of the schedule, at its beginning, in which images have half their size (progressive resizing)."""
    compiled: bool = False
    """Whether network and loss are compiled by `torch.compile`, which takes about 30 s."""


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained network, the loss over its training, and times [s]."""

    network: nn.Module
    losses: list[float]
    """Mean loss of each tenth of the training."""
    stream_seconds: float
    seconds: float
    """Total time [s]."""
    views: int
    samples: int
    """Views trained on, repeats counted."""


def warp_views(images: torch.Tensor, classes: torch.Tensor, recipe: Recipe) -> tuple[torch.Tensor, torch.Tensor]:
    """Geometric augmentation of images (B, 3 or 4, H, W) float32 with classes (B, H, W) int64: scale, rotation, shift, with mirrored
    borders. Depth, the fourth channel, is of the nearest pixel, and becomes less as objects become larger."""
    count, height, width = classes.shape
    draw = torch.rand(4, count, device=images.device) * 2 - 1
    factor, angle, aspect = recipe.scale ** -draw[0], draw[1] * math.radians(recipe.rotation), height / width
    cosine, sine, reach = factor * angle.cos(), factor * angle.sin(), (factor - 1).abs()
    rows = [torch.stack([cosine, -sine * aspect, reach * draw[2]], 1), torch.stack([sine / aspect, cosine, reach * draw[3]], 1)]
    grid = functional.affine_grid(torch.stack(rows, 1), [count, 1, height, width], align_corners=False)
    depth = functional.grid_sample(images[:, 3:], grid, "nearest", "reflection", align_corners=False) * factor.view(-1, 1, 1, 1)
    images = functional.grid_sample(images[:, :3], grid, "bilinear", "reflection", align_corners=False)
    labels = functional.grid_sample(classes[:, None].float(), grid, "nearest", "reflection", align_corners=False)
    return torch.cat((images, depth.clamp(max=1)), dim=1), labels[:, 0].round().long()


def jitter_views(images: torch.Tensor, strength: float) -> torch.Tensor:
    """Photometric augmentation of images (B, 3, H, W) in 0..1: gain and balance, contrast, saturation, gamma, blur of half, noise."""

    def spread(channels: int, width: float) -> torch.Tensor:
        return torch.exp(width * strength * (torch.rand(len(images), channels, 1, 1, device=images.device) * 2 - 1))

    luma = images.new_tensor(LUMA).view(1, 3, 1, 1)
    images = images * spread(1, 1.0) * spread(3, 0.4)
    mean = (images * luma).sum(1, keepdim=True).mean((2, 3), keepdim=True)
    images = mean + spread(1, 1.0) * (images - mean)
    grey = (images * luma).sum(1, keepdim=True)
    images = (grey + spread(1, 1.5) * (images - grey)).clamp(1e-4, 1.0) ** spread(1, 1.0)
    blurred = functional.avg_pool2d(functional.pad(images, (1, 1, 1, 1), "replicate"), 3, 1)
    share = torch.rand(len(images), 1, 1, 1, device=images.device)
    images = images + torch.clamp(2 * share - 1, 0) * (blurred - images)
    level = 0.2 * strength * torch.rand(len(images), 1, 1, 1, device=images.device) ** 2
    return (images + level * torch.randn_like(images)).clamp(0, 1)


@cache
def _jpeg_tables(device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Quantization tables (quality, 3, 8, 8) of levels 0..1, and the orthonormal DCT matrix (8, 8)."""
    tables = np.empty((QUALITIES, 2, BLOCK * BLOCK), np.float32)
    for quality in range(QUALITIES):
        tables[quality, :, zigzag_order()] = quantization(quality).T / 255.0
    frequency, place = np.mgrid[:BLOCK, :BLOCK]
    matrix = np.cos((2 * place + 1) * frequency * np.pi / (2 * BLOCK)) * np.where(frequency, 0.5, 0.5**1.5)
    channels = tables.reshape(QUALITIES, 2, BLOCK, BLOCK)[:, [0, 1, 1]]
    return torch.from_numpy(channels).to(device), torch.from_numpy(matrix.astype(np.float32)).to(device)


def compress_views(images: torch.Tensor, quality: torch.Tensor) -> torch.Tensor:
    """Images (B, 3, H, W) in 0..1 after JPEG compression of an integer `quality` each (B), without chroma subsampling: an image that a
    camera compresses at twice the size has chroma of full size once it is reduced. Sides are multiples of BLOCK [px]."""
    tables, dct = _jpeg_tables(images.device)
    count, _, height, width = images.shape
    matrix = images.new_tensor(YCC)
    values = torch.einsum("kc,bchw->bkhw", matrix, images) - images.new_tensor((128 / 255, 0.0, 0.0)).view(1, 3, 1, 1)
    blocks = values.view(count, 3, height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    steps = tables[quality].view(count, 3, 1, BLOCK, 1, BLOCK)
    levels = torch.einsum("ui,bkyixj,vj->bkyuxv", dct, blocks, dct).div(steps).round_().mul_(steps)
    values = torch.einsum("ui,bkyuxv,vj->bkyixj", dct, levels, dct).reshape(count, 3, height, width)
    values = values + images.new_tensor((128 / 255, 0.0, 0.0)).view(1, 3, 1, 1)
    return torch.einsum("ck,bkhw->bchw", torch.linalg.inv(matrix), values).clamp(0, 1)


def halve_views(images: torch.Tensor, classes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (B, 3 or 4, H, W) and classes (B, H, W) of half the size: means of colours, depth and class of one pixel of four."""
    colors = functional.avg_pool2d(images[:, :3], 2)
    nearest = (..., slice(1, None, 2), slice(1, None, 2))
    return torch.cat((colors, images[:, 3:][nearest]), dim=1), classes[nearest]


def _prepare(images: torch.Tensor, classes: torch.Tensor, recipe: Recipe, half: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Network input (B, 3 or 4, H, W) float32 in -0.5..0.5 and classes, after augmentation; of half the size if `half`."""
    values = images.float() / 255
    if recipe.scale > 1:
        values, classes = warp_views(values, classes, recipe)
    if half:
        values, classes = halve_views(values, classes)
    colors = jitter_views(values[:, :3], recipe.jitter) if recipe.jitter else values[:, :3]
    if recipe.jpeg:
        quality = recipe.jpeg + (QUALITIES - recipe.jpeg) * torch.rand(len(values), device=values.device)
        colors = compress_views(colors, quality.long().clamp(1, QUALITIES - 1))
    return torch.cat((colors, values[:, 3:]), dim=1) - 0.5, classes


def segmentation_loss(logits: torch.Tensor, classes: torch.Tensor, dice: float) -> torch.Tensor:
    """Cross entropy of logits (B, C, H, W), and `dice` times the Dice loss: over the pixels of the batch, averaged
    over the objects that occur in it. `classes` (B, H, W) int64; class 0 is the background."""
    # A view where channels are last in memory; softmax then reads rows.
    rows, truth = logits.permute(0, 2, 3, 1).flatten(0, 2).float(), classes.flatten()
    loss = functional.cross_entropy(rows, truth)
    if dice:
        shares = rows.softmax(1)
        exact = torch.zeros_like(shares).scatter_(1, truth[:, None], 1.0)
        sizes = exact.sum(0)
        similar = 2 * (shares * exact).sum(0) / (shares.sum(0) + sizes).clamp(min=1.0)
        occurs = (sizes > 0).float()[1:]
        loss = loss + dice * (((1 - similar[1:]) * occurs).sum() / occurs.sum().clamp(min=1.0))
    return loss


class _Trainer:
    """One training: network, optimizer and schedule."""

    def __init__(self, recipe: Recipe, classes: int, device: torch.device, seed: int) -> None:
        torch.manual_seed(seed)
        self.recipe, self.device, self.started = recipe, device, time.perf_counter()
        self.network = NETWORKS[recipe.network](classes, recipe.width, 3 + recipe.depth).to(device, memory_format=torch.channels_last)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), recipe.rate, fused=device.type == "cuda")
        torch.backends.cudnn.benchmark = True  # Sizes are fixed: the fastest convolutions are found once.
        self.logits = torch.compile(self.network, dynamic=False) if recipe.compiled else self.network
        self.loss = torch.compile(segmentation_loss, dynamic=False) if recipe.compiled else segmentation_loss
        self.total = max(1, round(recipe.views * recipe.passes / recipe.batch))
        self.losses: list[torch.Tensor] = []
        self.waited = 0.0
        """Time before the first step, in which the stream filled the pool [s]."""

    @property
    def progress(self) -> float:
        """Fraction of the schedule: of the steps, or of the time where this is nearer to its end."""
        left = max(self.recipe.seconds - self.waited, 1.0)
        return max(len(self.losses) / self.total, (time.perf_counter() - self.started - self.waited) / left)

    def step(self, pool: Pool) -> None:
        """Train on a batch."""
        done = self.progress
        factor = done / WARM_UP if done < WARM_UP else 0.5 + 0.5 * math.cos(math.pi * min(1.0, (done - WARM_UP) / (1 - WARM_UP)))
        self.optimizer.param_groups[0]["lr"] = self.recipe.rate * max(factor, LEAST_RATE)
        images, classes = _prepare(*pool.draw(self.recipe.batch), self.recipe, done < self.recipe.half)
        images = images.contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            logits = self.logits(images)
        loss = self.loss(logits, classes, self.recipe.dice)
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), MAX_NORM)
        self.optimizer.step()
        self.losses.append(loss.detach())


def train(source: Source, recipe: Recipe, classes: int, device: torch.device, seed: int, pool: Pool | None = None) -> tuple[Trained, Pool]:
    """Train a network on views of a stream. The pool is filled first, for at most half of the time limit; the rest comes while training.

    A `pool` that is given goes on to be filled: one of `recipe.views` views or more is trained on as it is.

    Raises:
        SynpickError: Settings, models or lights cannot be used.
    """
    pool, trainer = pool or Pool(min(recipe.views, recipe.capacity), seed), _Trainer(recipe, classes, device, seed)
    batches = source.batches()
    pool.fill(batches, min(pool.capacity, recipe.views), FILLING * recipe.seconds)
    more = pool.seen < recipe.views
    if not more:
        batches.close()
    trainer.waited = time.perf_counter() - trainer.started
    while trainer.progress < 1.0:
        if more and pool.seen < recipe.views and len(trainer.losses) >= pool.seen * trainer.total / recipe.views:
            more = pool.fill(batches, min(pool.seen + recipe.batch, recipe.views))
        trainer.step(pool)
    batches.close()
    values = torch.stack(trainer.losses).tolist()
    parts = [values[len(values) * part // 10 : max(1, len(values) * (part + 1) // 10)] for part in range(10)]
    losses = [sum(part) / len(part) for part in parts if part]
    seconds = time.perf_counter() - trainer.started
    trained = Trained(trainer.network.eval(), losses, pool.seconds, seconds, pool.seen, len(values) * recipe.batch)
    return trained, pool
