"""PyTorch dataset (iterable style) of a stream: views that are made while the network trains, as tensors.

    views = synpick_warp.online.dataset.StreamDataset("synpick", worlds=64, episodes=range(1000), fields=("rgb", "classes"))
    for batch in torch.utils.data.DataLoader(views, batch_size=None):
        ...

This module needs PyTorch. On a GPU the tensors lie in the buffers of the batch, without a copy, and are valid until the next one.
"""

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch  # pyright: ignore[reportMissingImports]
from torch.utils.data import IterableDataset, get_worker_info  # pyright: ignore[reportMissingImports]

from synpick_warp.configs.cell.cameras import COLOR
from synpick_warp.configs.check import to_index
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.view import MILLIMETERS
from synpick_warp.errors import ConfigError
from synpick_warp.online.stream import ARGUMENTS, Selection, choose_episodes, open_stream, resolve_settings
from synpick_warp.stages.online.batches import ViewBatch
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress

Sample = dict[str, Any]
ALL, VISIBLE = 0, 2
"""Columns of `ViewBatch.pixels`."""
AMODAL_BOX, VISIBLE_BOX = 0, 1
"""Rows of `ViewBatch.boxes`."""


def _classes(batch: ViewBatch) -> Any:
    """obj_id of the visible instance, 0 elsewhere (B, H, W) int64."""
    instance, object_ids = torch.from_dlpack(batch.instance).long(), torch.from_dlpack(batch.object_id).long()
    table = torch.nn.functional.pad(object_ids.clamp(min=0), (1, 0))
    index = torch.where(instance < table.shape[1], instance, 0)
    return table.gather(1, index.flatten(1)).view_as(instance)


def _corners(batch: ViewBatch, kind: int) -> Any:
    """Boxes with exclusive maxima, as torchvision has them; 0 without pixels (B, I, 4) float32."""
    boxes = torch.from_dlpack(batch.boxes)[:, :, kind]
    corners = boxes + boxes.new_tensor((0, 0, 1, 1))
    return torch.where(boxes[..., 2:3] < boxes[..., 0:1], 0, corners).float()


def _visibility(batch: ViewBatch) -> Any:
    """Visible fraction of each instance's silhouette, float; 0 for none."""
    pixels = torch.from_dlpack(batch.pixels)
    return pixels[..., VISIBLE].float() / pixels[..., ALL].clamp(min=1).float()


FIELDS: Mapping[str, Callable[[ViewBatch], Any]] = {
    "rgb": lambda batch: torch.from_dlpack(batch.color).permute(0, 3, 1, 2),
    "depth": lambda batch: torch.from_dlpack(batch.depth).float().mul_(batch.depth_scale / MILLIMETERS).unsqueeze(1),
    "classes": _classes,
    "instances": lambda batch: torch.from_dlpack(batch.instance),
    "masks": lambda batch: torch.from_dlpack(batch.visible_masks()),
    "amodal_masks": lambda batch: torch.from_dlpack(batch.amodal_masks()),
    "boxes": lambda batch: _corners(batch, VISIBLE_BOX),
    "amodal_boxes": lambda batch: _corners(batch, AMODAL_BOX),
    "object_ids": lambda batch: torch.from_dlpack(batch.object_id),
    "visibility": _visibility,
    "poses": lambda batch: torch.from_dlpack(batch.object_to_camera),
    "intrinsics": lambda batch: torch.from_dlpack(batch.intrinsics),
    "world_to_camera": lambda batch: torch.from_dlpack(batch.world_to_camera),
}
"""Contents of a sample; names as in `dataset.pytorch.FIELDS`, with a first dimension B of views. Images: rgb (B, 3, H, W) uint8, depth
(B, 1, H, W) float32 [m], classes (B, H, W) int64: obj_id, 0: no object; instances (B, H, W) uint8 as
`ViewBatch.instance`. One row per instance_id, present or not: object_ids (B, I) int32, below 0: none or no label; masks
(B, I, H, W) bool, boxes (B, I, 4) float32 [px], visibility (B, I) float32, poses (B, I, 4, 4) float32, object to camera [m]. Cameras:
intrinsics (B, 3, 3) [px], world_to_camera (B, 4, 4) [m], float32. Layers by name, as they are before quantization."""


class StreamDataset(IterableDataset):
    """Iterable-style dataset of a stream, in batches (for `DataLoader(views, batch_size=None)`) or view by view.

    One pass is one epoch: worlds are built, the epoch's episodes run, and all is freed. Workers of a DataLoader deal the episodes out by
    index and simulate them beside each other, each in worlds of its own; this is for the CPU. On a GPU there is nothing for workers to do
    (`num_workers=0`): the device renders the next batch while the network trains on this one.
    """

    def __init__(
        self,
        config: Config | Path | str | None = None,
        settings: Mapping[str, object] | None = None,
        *,
        fields: Sequence[str] = ("rgb", "classes"),
        episodes: int | range | None = None,
        fresh: bool = True,
        shard: tuple[int, int] = (0, 1),
        splits: Sequence[str] = (),
        cameras: Sequence[int] | None = None,
        stride: int = 1,
        batched: bool = True,
        shuffle: int = 0,
        transform: Callable[[Sample], Any] | None = None,
        **arguments: object,
    ) -> None:
        """
        Args:
            config: Settings, as for `synpick_warp.stream`, from which also `settings`, `shard`, `splits`, `cameras` and `stride` are.
            fields: Contents of a sample, of FIELDS, and names of rendered layers; each has its `episode`, `camera` and `frame`, too.
            episodes: Episodes of an epoch: how many, or a range of indices; None: those of the settings.
            fresh: Whether epoch e has the indices that follow those of epoch e - 1 (see `set_epoch`), so that no view comes twice; only
                with `episodes`. False: every epoch has the same.
            batched: Whether a sample is a batch, whose tensors are views of the stream's buffers, valid until the next one in a process
                without workers; False: a view, with tensors of its own, which DataLoader collates to batches.
            shuffle: Views of a buffer from which samples are drawn at random, as the views of a batch are those of one moment; 0: none.
                Only view by view.
            transform: Called with each sample; must be picklable for workers.
            arguments: worlds, device, seed, mode, resolution, models, lights, layers, batch, as for `synpick_warp.stream`.

        Raises:
            ConfigError: A setting or field is unknown, or a value is not allowed.
            TypeError: There is no argument of a name in `arguments`.
        """
        unknown = sorted(set(arguments) - set(ARGUMENTS))
        if unknown:
            raise TypeError(f"StreamDataset has no argument {unknown[0]!r}; settings have their full key: {{'physics.step': 2e-3}}")
        self.config = resolve_settings(config, settings or {}, arguments, bool(splits))
        rig = self.config.rig
        self.selection = Selection(cameras, stride).resolve(len(rig))
        for name in fields:
            image = COLOR if name == "rgb" else name
            if image in (COLOR, *self.config.render.layers) and not all(
                rig.writes(camera, image) for camera in self.selection.cameras or ()
            ):
                raise ConfigError(f"the field {name} is not among the modalities of all cameras; choose others, by cameras or fields")
            if name not in FIELDS and name not in self.config.render.layers:
                known = ", ".join((*FIELDS, *self.config.render.layers))
                raise ConfigError(f"there is no field {name}; fields: {known}; others are layers that render.layers names")
        if (to_index(shuffle) or 0) < 0 or to_index(shuffle) is None:
            raise ConfigError(f"shuffle is {shuffle!r}; allowed: a number of views, or 0")
        if shuffle and batched:
            raise ConfigError(f"shuffle is {shuffle}, but whole batches are not shuffled; set batched=False")
        self.fields, self.batched, self.shuffle, self.transform = tuple(fields), batched, shuffle, transform
        self.episodes = range(episodes) if isinstance(episodes, int) else episodes
        self.fresh, self.shard, self.splits = fresh, shard, tuple(splits)
        choose_episodes(DataLayout.of(self.config), self.episodes, shard, self.splits)
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # Workers that live through all epochs see it change.

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch index of the next iteration, as `DistributedSampler.set_epoch` does; call it before iterating."""
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[Any]:
        """One epoch; in a worker, its part. Raises ConfigError if a worker would use a GPU."""
        info, (index, count) = get_worker_info(), self.shard
        if info is not None:
            index, count = index + count * info.id, count * info.num_workers
            device = pick_device(self.config.bake.device)
            if device.is_cuda:
                raise ConfigError(f"a DataLoader's workers cannot share {device.alias}; use num_workers=0, or device='cpu' for workers")
        episodes, epoch = self.episodes, int(self._epoch)
        if episodes is not None and self.fresh:
            span = episodes.step * len(episodes)
            episodes = range(episodes.start + epoch * span, episodes.stop + epoch * span, episodes.step)
        if not choose_episodes(DataLayout.of(self.config), episodes, (index, count), self.splits)[1]:
            return
        samples = self._samples(episodes, (index, count), copy=info is not None or not self.batched)
        if self.shuffle:
            samples = _shuffle(samples, self.shuffle, random.Random(f"{self.config.bake.seed} {epoch} {index}"))
        yield from samples if self.transform is None else map(self.transform, samples)

    def _samples(self, episodes: range | None, shard: tuple[int, int], copy: bool) -> Iterator[Sample]:
        """Yield samples of a stream of these episodes (None: all) and shard; `copy`: tensors that outlive the batch."""
        stream = open_stream(self.config, SilentProgress(), episodes=episodes, shard=shard, splits=self.splits, selection=self.selection)
        with stream:
            for batch in stream:
                sample = {name: FIELDS[name](batch) if name in FIELDS else torch.from_dlpack(batch.layers[name]) for name in self.fields}
                sample |= {name: torch.from_dlpack(getattr(batch, name)) for name in ("episode", "camera", "frame")}
                if copy:
                    sample = {name: values.clone(memory_format=torch.contiguous_format) for name, values in sample.items()}
                if self.batched:
                    yield sample
                else:
                    yield from ({name: values[view] for name, values in sample.items()} for view in range(len(batch)))


def _shuffle(samples: Iterator[Sample], size: int, generator: random.Random) -> Iterator[Sample]:
    """Yield the samples in an order drawn from a shuffle buffer of `size` samples."""
    buffer: list[Sample] = []
    for sample in samples:
        if len(buffer) < size:
            buffer.append(sample)
            continue
        index = generator.randrange(size)
        buffer[index], sample = sample, buffer[index]
        yield sample
    generator.shuffle(buffer)
    yield from buffer
