"""Training of a segmentation network on views of a stream, with augmentation, by cross entropy and soft Dice.

Experience replay (Lin, 1992): views are copied to a pool on the device, from which batches are drawn. Views of one batch of a stream show
few piles; batches from a pool mix many, and each view is trained on several times.

The network is a residual U-Net (Zhang et al., GRSL 2018), from scratch. AdamW with a warm-up and a cosine schedule, mixed precision
(bfloat16) on a GPU. Augmentation is geometric (scale, rotation, shift, crop, mirrored borders) and photometric (gain, contrast, saturation,
gamma, blur and sharpening, noise, JPEG), each image by its own draw.
"""

import itertools
import math
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]
from torch.nn import functional  # pyright: ignore[reportMissingImports]

from synpick_warp.kernels.encoding.dct import ZIGZAG
from synpick_warp.system.codecs.jpeg import QUALITIES, quantization
from tools.examples.train_online import LEARNING_RATE, schedule

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in luma (ITU-R BT.601)."""
YCC = (LUMA, (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
"""Y, Cb and Cr of red, green and blue (JFIF)."""
MIDDLE = (128 / 255, 0.0, 0.0)
"""Values of Y, Cb and Cr that the level shift of JPEG maps to 0."""
BLOCK = 8
"""Side of a JPEG block [px]."""
DEPTHS = (2, 3, 4, 3)
"""Residual blocks of each level of the network."""
MAX_NORM = 5.0
"""Norm to which gradients are clipped."""
SHARPENING = 2.5
"""Largest weight of unsharp masking: halos, and the grain of flat blocks at half size, have the medians of unlabelled photographs."""
FIRST = 0.125
"""Fraction of the pool that is filled before training starts."""
FILLING = 0.5
"""Maximum fraction of the time limit that passes before training starts."""
PACE = 4.0
"""Replay ratio while the stream runs: maximum number of training samples for each new view, or the number of epochs if that is smaller."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters, none of which is chosen on real pictures."""

    views: int
    passes: float
    """Number of epochs."""
    batch: int
    seconds: float
    """Time limit of rendering and training together [s], by which the schedule ends. Compilation comes before."""
    capacity: int
    """Views in the pool, at most."""
    width: int = 64
    """Channels of the network's first level."""
    scale: float = 1.5
    """Largest scale factor; the smallest is its reciprocal."""
    rotation: float = 15.0
    """Largest rotation in each direction [°]."""
    jitter: float = 0.3
    """Strength of the photometric augmentation; 0: none."""
    jpeg: float = 40.0
    """Lowest JPEG quality of the photometric augmentation; 0: no JPEG."""
    dice: float = 1.0
    """Weight of the Dice loss, which is added to the cross entropy."""
    rate: float = LEARNING_RATE
    """Peak learning rate of the schedule."""
    half: float = 0.7
    """End of the stage with images of half the size, as a fraction of the schedule (progressive resizing)."""
    crop: float = 0.5
    """Side length of random crops in the rest of the schedule, as a fraction of the image's; 1: whole images."""


@dataclass(eq=False)
class ViewPool:
    """Replay buffer of views on the device, `images` (N, 3, H, W) uint8 and obj_ids `classes` (N, H, W) uint8; once full, new ones
    replace random ones."""

    capacity: int
    seed: int
    count: int = 0
    seen: int = 0
    """Views that have been added."""
    seconds: float = 0.0
    """Time that the stream took."""
    images: torch.Tensor | None = field(default=None, repr=False)
    classes: torch.Tensor | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._random = torch.Generator().manual_seed(self.seed)

    def add(self, images: torch.Tensor, classes: torch.Tensor) -> None:
        """Copy views into the pool."""
        if self.images is None or self.classes is None:
            self.images = images.new_empty((self.capacity, *images.shape[1:]))
            self.classes = classes.new_empty((self.capacity, *classes.shape[1:]))
        new = min(len(images), self.capacity - self.count)
        replaced = torch.randperm(self.count if new < len(images) else 0, generator=self._random)[: len(images) - new]
        places = self._on_device(torch.cat((torch.arange(self.count, self.count + new), replaced)))
        for kept, added in zip(self.tensors(), (images, classes), strict=True):
            kept[places] = added[: len(places)]
        self.count += new
        self.seen += len(images)

    def fill(self, batches: Iterator[tuple[torch.Tensor, torch.Tensor]], views: int, seconds: float = math.inf) -> bool:
        """Add batches until `views` or more have been added in all; False: the stream ended, or `seconds` passed before."""
        started = time.perf_counter()
        while self.seen < views and time.perf_counter() - started < seconds:
            batch = next(batches, None)
            if batch is None:
                break
            self.add(*batch)
        self.seconds += time.perf_counter() - started
        return self.seen >= views

    def draw(self, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Batch of random views, drawn with replacement: images (size, 3, H, W) uint8, obj_ids (size, H, W) int64."""
        images, classes = self.tensors()
        chosen = self._on_device(torch.randint(self.count, (size,), generator=self._random))
        return images[chosen], classes[chosen].long()

    def _on_device(self, places: torch.Tensor) -> torch.Tensor:
        """Copy of indices on the device of the pool, for which the host does not wait."""
        device = self.tensors()[0].device
        return places.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else places

    def tensors(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Images and obj_ids of all places, of which the first `count` are filled; the pool must have views."""
        assert self.images is not None
        assert self.classes is not None
        return self.images, self.classes


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained network, the loss over its training, and times [s]."""

    network: nn.Module
    losses: list[float]
    """Mean loss of each tenth of the training."""
    stream_seconds: float
    seconds: float
    """Time of rendering and training together [s]."""
    views: int
    samples: int
    """Views trained on, repeats counted."""


class ResidualNetwork(nn.Module):
    """Residual U-Net: a stem of 1/2 of the image's size with half of `width` channels, levels of 1/4 to 1/32 with `width` to 8 x `width`
    channels, whose pixels see up to 420 pixels of the image to each side. Blocks begin at 1/4, as in a ResNet: at 1/2 they would take four
    times the operations."""

    def __init__(self, classes: int, width: int) -> None:
        super().__init__()
        widths = [width // 2, *(width * factor for factor in (1, 2, 4, 8))]
        self.stem = _convolution(3, widths[0], size=5, stride=2)
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(before, after, stride=2), *(_Block(after) for _ in range(depth)))
            for (before, after), depth in zip(itertools.pairwise(widths), DEPTHS, strict=True)
        )
        self.up = nn.ModuleList(_convolution(low + high, high) for high, low in itertools.pairwise(widths))
        self.head = nn.Conv2d(widths[0], classes, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Class logits of images (B, 3, H, W) with even sides, uint8, or float32 that is normalized already. In training they have half
        the resolution (B, classes, H / 2, W / 2); in evaluation they are interpolated to (B, classes, H, W)."""
        skips = [self.stem(image.float().div(255).sub(0.5) if image.dtype == torch.uint8 else image)]
        for level in self.down:
            skips.append(level(skips[-1]))
        x = skips.pop()
        for level, skip in zip(reversed(self.up), reversed(skips), strict=True):
            x = level(torch.cat((upsample(x, skip.shape[2:]), skip), dim=1))
        x = self.head(x)
        if self.training:
            return x
        between = functional.interpolate(x, size=[2 * side - 1 for side in x.shape[2:]], mode="bilinear", align_corners=True)
        return functional.pad(between, (0, 1, 0, 1), "replicate")


class _Block(nn.Module):
    """Residual block of two 3 x 3 convolutions (He et al., CVPR 2016)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Features of the size of `x`."""
        return functional.relu(x + self.second(self.first(x)))


def _convolution(before: int, after: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(before, after, size, stride, size // 2, bias=False), nn.BatchNorm2d(after), nn.ReLU())


def upsample(x: torch.Tensor, size: Sequence[int]) -> torch.Tensor:
    """Bilinear interpolation of features (B, C, H, W) to a height and width of `size`."""
    return functional.interpolate(x, size=size, mode="bilinear", align_corners=False)


def warp_views(images: torch.Tensor, classes: torch.Tensor, recipe: Recipe, crop: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Geometric augmentation of images (B, 3, H, W) float32 with classes (B, H, W) int64: scale, rotation, shift, with mirrored borders,
    and a random crop whose sides are the fraction `crop` of H and W."""
    count, height, width = classes.shape
    draw = torch.rand(4, count, device=images.device) * 2 - 1
    factor, angle, aspect = recipe.scale ** -draw[0], draw[1] * math.radians(recipe.rotation), height / width
    covered = factor * crop
    cosine, sine, reach = covered * angle.cos(), covered * angle.sin(), (covered - 1).abs()
    rows = [torch.stack([cosine, -sine * aspect, reach * draw[2]], 1), torch.stack([sine / aspect, cosine, reach * draw[3]], 1)]
    size = [count, 1, *(BLOCK * round(side * crop / BLOCK) if crop < 1 else side for side in (height, width))]
    grid = functional.affine_grid(torch.stack(rows, 1), size, align_corners=False)
    images = functional.grid_sample(images, grid, "bilinear", "reflection", align_corners=False)
    labels = functional.grid_sample(classes[:, None].float(), grid, "nearest", "reflection", align_corners=False)
    return images, labels[:, 0].round().long()


def jitter_views(images: torch.Tensor, strength: float) -> torch.Tensor:
    """Photometric augmentation of images (B, 3, H, W) in 0..1: gain, balance, contrast, saturation, gamma, noise, blur or unsharp mask."""

    def spread(channels: int, width: float) -> torch.Tensor:
        return torch.exp(width * strength * (torch.rand(len(images), channels, 1, 1, device=images.device) * 2 - 1))

    luma = _constant(LUMA, images.device).view(1, 3, 1, 1)
    images = images * spread(1, 1.0) * spread(3, 0.4)
    mean = (images * luma).sum(1, keepdim=True).mean((2, 3), keepdim=True)
    images = mean + spread(1, 1.0) * (images - mean)
    grey = (images * luma).sum(1, keepdim=True)
    images = (grey + spread(1, 1.5) * (images - grey)).clamp(1e-4, 1.0) ** spread(1, 1.0)
    level = 0.2 * strength * torch.rand(len(images), 1, 1, 1, device=images.device) ** 2
    images = images + level * torch.randn_like(images)  # Before sharpening, as in a camera: it amplifies noise.
    blurred = functional.avg_pool2d(functional.pad(images, (1, 1, 1, 1), "replicate"), 3, 1)
    weight = (1 + SHARPENING) * torch.rand(len(images), 1, 1, 1, device=images.device) - SHARPENING
    return torch.lerp(images, blurred, weight).clamp(0, 1)


@cache
def _constant(values: tuple[float | tuple[float, ...], ...], device: torch.device) -> torch.Tensor:
    """Constant float32 tensor, cached for each device: a copy from pageable memory would synchronize with the host at each use."""
    return torch.tensor(values, dtype=torch.float32, device=device)


@cache
def _jpeg_tables(device: torch.device) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Quantization tables (quality, 3, 8, 8) of levels 0..1, the orthonormal DCT matrix (8, 8), and the inverse of YCC (3, 3)."""
    steps = np.empty((QUALITIES, 2, BLOCK * BLOCK), np.float32)
    for quality in range(QUALITIES):
        steps[quality, :, list(ZIGZAG)] = quantization(quality).T / 255.0
    frequency, place = np.mgrid[:BLOCK, :BLOCK]
    matrix = np.cos((2 * place + 1) * frequency * np.pi / (2 * BLOCK)) * np.where(frequency, 0.5, 0.5**1.5)
    made = (steps.reshape(QUALITIES, 2, BLOCK, BLOCK)[:, [0, 1, 1]], matrix, np.linalg.inv(YCC))
    tables, dct, colors = (torch.from_numpy(one.astype(np.float32)).to(device) for one in made)
    return tables, dct, colors


def compress_views(images: torch.Tensor, quality: torch.Tensor) -> torch.Tensor:
    """Images (B, 3, H, W) in 0..1 after JPEG compression of an integer `quality` each (B), without chroma subsampling: an image that a
    camera compresses at twice the size has chroma of full size once it is reduced. Sides are multiples of BLOCK [px]."""
    tables, dct, colors = _jpeg_tables(images.device)
    count, _, height, width = images.shape
    middle = _constant(MIDDLE, images.device).view(1, 3, 1, 1)
    values = torch.einsum("kc,bchw->bkhw", _constant(YCC, images.device), images) - middle
    blocks = values.view(count, 3, height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    steps = tables[quality].view(count, 3, 1, BLOCK, 1, BLOCK)
    levels = torch.einsum("ui,bkyixj,vj->bkyuxv", dct, blocks, dct).div(steps).round_().mul_(steps)
    values = torch.einsum("ui,bkyuxv,vj->bkyixj", dct, levels, dct).reshape(count, 3, height, width)
    return torch.einsum("ck,bkhw->bchw", colors, values + middle).clamp(0, 1)


def prepare_batch(images: torch.Tensor, classes: torch.Tensor, recipe: Recipe, progress: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Augmentation and normalization of a batch; the elapsed fraction of the schedule, `progress`, determines the size of its images.

    Returns the network's input (B, 3, H, W) float32 in -0.5..0.5, and classes (B, H, W), both downsampled by two, where the class is that
    of one pixel of four, or cropped.
    """
    values, crop = images.float() / 255, 1.0 if progress < recipe.half else recipe.crop
    if recipe.scale > 1 or crop < 1:
        values, classes = warp_views(values, classes, recipe, crop)
    if progress < recipe.half:
        values, classes = functional.avg_pool2d(values, 2), classes[..., 1::2, 1::2]
    if recipe.jitter:
        values = jitter_views(values, recipe.jitter)
    if recipe.jpeg:
        quality = recipe.jpeg + (QUALITIES - recipe.jpeg) * torch.rand(len(values), device=values.device)
        values = compress_views(values, quality.long().clamp(1, QUALITIES - 1))
    return values - 0.5, classes


def segmentation_loss(logits: torch.Tensor, classes: torch.Tensor, dice: float) -> torch.Tensor:
    """Cross entropy of logits (B, C, H, W), and `dice` times the Dice loss: over the pixels of the batch, averaged
    over the objects that occur in it. `classes` (B, H, W) int64; class 0 is the background."""
    # A view where channels are last in memory; softmax then reads rows.
    rows, truth = logits.permute(0, 2, 3, 1).flatten(0, 2).float(), classes.flatten()
    logs = rows.log_softmax(1)
    exact = (truth[:, None] == torch.arange(rows.shape[1], device=rows.device)).float()
    loss = -(logs * exact).sum() / len(rows)  # PyTorch's `nll_loss` adds up rows in one block of threads, which takes 2 ms.
    if dice:
        shares, sizes = logs.exp(), exact.sum(0)
        similar = 2 * (shares * exact).sum(0) / (shares.sum(0) + sizes).clamp(min=1.0)
        occurs = (sizes > 0).float()[1:]
        loss = loss + dice * (((1 - similar[1:]) * occurs).sum() / occurs.sum().clamp(min=1.0))
    return loss


class _Trainer:
    """Training loop state: network, optimizer, learning rate schedule. Creating it seeds PyTorch and starts the clock."""

    def __init__(self, recipe: Recipe, classes: int, device: torch.device, seed: int) -> None:
        torch.manual_seed(seed)
        self.recipe, self.device, self.started = recipe, device, time.perf_counter()
        self.network = ResidualNetwork(classes, recipe.width).to(device, memory_format=torch.channels_last)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), recipe.rate, fused=device.type == "cuda")
        torch.backends.cudnn.benchmark = True  # Sizes are fixed: the fastest convolutions are found once.
        self.total = max(1, round(recipe.views * recipe.passes / recipe.batch))
        self.losses: list[torch.Tensor] = []
        self.waited = 0.0
        """Time before the first step, in which the first part of the pool was filled [s]."""

    @property
    def progress(self) -> float:
        """Elapsed fraction of the schedule: the larger of those of steps and of time."""
        left = max(self.recipe.seconds - self.waited, 1.0)
        return max(len(self.losses) / self.total, (time.perf_counter() - self.started - self.waited) / left)

    def step(self, pool: ViewPool) -> None:
        """Train on a batch drawn from the pool, in mixed precision, and append its loss to `losses`."""
        done = self.progress
        self.optimizer.param_groups[0]["lr"] = self.recipe.rate * schedule(done)
        images, classes = prepare_batch(*pool.draw(self.recipe.batch), self.recipe, done)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            logits = self.network(images.contiguous(memory_format=torch.channels_last))
        loss = segmentation_loss(logits, classes[..., ::2, ::2], self.recipe.dice)
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), MAX_NORM)
        self.optimizer.step()
        self.losses.append(loss.detach())


def train(batches: Generator[tuple[torch.Tensor, torch.Tensor]], recipe: Recipe, classes: int, device: torch.device, seed: int) -> Trained:
    """Train a network on views of a stream. Training starts when a first part of the pool is filled; the rest is filled during training.

    `batches`: images (B, 3, H, W) and obj_ids (B, H, W) uint8 of the stream; a batch is valid until the next one. Raises SynpickError:
    settings, models or lights cannot be used."""
    pool, trainer = ViewPool(min(recipe.views, recipe.capacity), seed), _Trainer(recipe, classes, device, seed)
    pool.fill(batches, math.ceil(FIRST * pool.capacity), FILLING * recipe.seconds)
    first, pace = pool.seen, min(PACE, recipe.passes)
    trainer.waited = time.perf_counter() - trainer.started
    while trainer.progress < 1.0:
        # Take batches from the stream, until it ends, as long as the replay ratio is exceeded.
        while len(trainer.losses) * recipe.batch >= pace * (pool.seen - first) and pool.fill(batches, pool.seen + 1):
            pass
        trainer.step(pool)
    batches.close()
    values = torch.stack(trainer.losses).tolist()
    parts = [values[len(values) * part // 10 : max(1, len(values) * (part + 1) // 10)] for part in range(10)]
    losses, seconds = [sum(part) / len(part) for part in parts if part], time.perf_counter() - trainer.started
    return Trained(trainer.network.eval(), losses, pool.seconds, seconds, pool.seen, len(values) * recipe.batch)
