"""Experience replay (Lin, 1992) for supervised training: a pool of views of a stream on the device, from which batches are drawn.

Views of one batch of a stream show few piles. Batches drawn from a pool mix many, and each view is trained on several times.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field

import torch  # pyright: ignore[reportMissingImports]

from synpick_warp.configs.schema import Config
from synpick_warp.online.dataset import StreamDataset


@dataclass(frozen=True, eq=False)
class ViewSource:
    """Stream of training views: its settings, episodes, and which frames are taken."""

    config: Config
    episodes: range
    stride: int
    """Every n-th frame of an episode."""
    cameras: tuple[int, ...] | None = None
    """Indices of the cameras whose views are taken; None: all."""

    def batches(self, views: int) -> Generator[tuple[torch.Tensor, torch.Tensor]]:
        """Images (B, 3, H, W) and obj_ids (B, H, W) uint8 of `views` views in total; a batch is valid until the next one."""
        fields = ("rgb", "classes")
        dataset = StreamDataset(self.config, fields=fields, episodes=self.episodes, stride=self.stride, cameras=self.cameras)
        for batch in torch.utils.data.DataLoader(dataset, batch_size=None):
            yield batch["rgb"][:views], batch["classes"][:views].to(torch.uint8)
            views -= len(batch["rgb"])
            if views <= 0:
                return


@dataclass(eq=False)
class ViewPool:
    """Replay buffer of views on the device; once full, new ones replace random ones.

    Attributes:
        images: (N, 3, H, W) uint8.
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


def hold_out(source: ViewSource, views: int) -> ViewPool:
    """Held-out views of a stream to measure on: the first that come, so those of the piles that settle soonest.

    Raises:
        SynpickError: Settings, models or lights cannot be used.
    """
    pool = ViewPool(views, 0)
    pool.fill(source.batches(views), views)
    return pool
