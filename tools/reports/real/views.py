"""Experience replay (Lin, 1992) for supervised training: a pool of views of a stream on the device, from which batches are drawn.

Views of one batch of a stream show few piles. Batches drawn from a pool mix many, and each view is trained on several times.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field

import torch  # pyright: ignore[reportMissingImports]
from torch.nn import functional  # pyright: ignore[reportMissingImports]

from synpick_warp.configs.schema import Config
from synpick_warp.online.dataset import StreamDataset

FARTHEST = 1.5
"""Depth that is coded by 255 [m], and all beyond: objects are nearer, and what is behind them differs from room to room."""


def code_depth(depth: torch.Tensor) -> torch.Tensor:
    """Depth [m] as uint8: 255 at FARTHEST, 0 where it is not measured."""
    return depth.mul(255 / FARTHEST).round_().clamp_(0, 255).to(torch.uint8)


@dataclass(frozen=True, eq=False)
class Source:
    """Stream of training views: its settings, episodes, and which frames are taken."""

    config: Config
    episodes: range
    stride: int
    """Every n-th frame of an episode."""
    shrink: int = 1
    """Factor by which images are reduced."""
    cameras: tuple[int, ...] | None = None
    """Indices of the cameras whose views are taken; None: all."""
    depth: bool = False
    """Whether images have depth as a fourth channel, by `code_depth`."""

    def batches(self) -> Generator[tuple[torch.Tensor, torch.Tensor]]:
        """Images (B, 3 or 4, H, W) and obj_ids (B, H, W) uint8, valid until the next are taken."""
        fields = ("rgb", "classes", "depth") if self.depth else ("rgb", "classes")
        dataset = StreamDataset(self.config, fields=fields, episodes=self.episodes, stride=self.stride, cameras=self.cameras)
        for batch in torch.utils.data.DataLoader(dataset, batch_size=None):
            image, classes = batch["rgb"], batch["classes"].to(torch.uint8)
            half = self.shrink // 2
            if self.shrink > 1:
                image = functional.avg_pool2d(image.float(), self.shrink).round_().to(torch.uint8)
                classes = classes[:, half :: self.shrink, half :: self.shrink][:, : image.shape[2], : image.shape[3]]
            if self.depth:
                depth = code_depth(batch["depth"])[:, :, half :: self.shrink, half :: self.shrink]
                image = torch.cat((image, depth[:, :, : image.shape[2], : image.shape[3]]), dim=1)
            yield image, classes


@dataclass(eq=False)
class Pool:
    """Replay buffer of views on the device; once full, new ones replace random ones.

    Attributes:
        images: (N, 3 or 4, H, W) uint8.
        classes: obj_ids (N, H, W) uint8.
    """

    capacity: int
    seed: int
    count: int = 0
    """Views in the pool."""
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
        kept = self.tensors()
        for image, classified in zip(images, classes, strict=True):
            place = self.count
            if place == self.capacity:
                place = int(torch.randint(self.capacity, (1,), generator=self._random))
            kept[0][place], kept[1][place] = image, classified
            self.count = min(self.count + 1, self.capacity)
            self.seen += 1

    def fill(self, batches: Iterator[tuple[torch.Tensor, torch.Tensor]], views: int, seconds: float = math.inf) -> bool:
        """Add views until `views` have been added in all; False: the stream ended, or `seconds` passed before."""
        started = time.perf_counter()
        while self.seen < views and time.perf_counter() - started < seconds:
            batch = next(batches, None)
            if batch is None:
                break
            self.add(*(part[: views - self.seen] for part in batch))
        self.seconds += time.perf_counter() - started
        return self.seen >= views

    def draw(self, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Batch of random views, drawn with replacement: images (size, 3 or 4, H, W) uint8, obj_ids (size, H, W) int64."""
        images, classes = self.tensors()
        chosen = torch.randint(self.count, (size,), generator=self._random).to(images.device)
        return images[chosen], classes[chosen].long()

    def tensors(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Images and obj_ids of all places, of which the first `count` are filled; the pool must have views."""
        assert self.images is not None
        assert self.classes is not None
        return self.images, self.classes


def hold_out(source: Source, views: int) -> Pool:
    """Held-out views of a stream to measure on: the first that come, so those of the piles that settle soonest.

    Raises:
        SynpickError: Settings, models or lights cannot be used.
    """
    pool = Pool(views, 0)
    batches = source.batches()
    pool.fill(batches, views)
    batches.close()
    return pool
