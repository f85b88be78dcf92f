"""The learned picker: pixel-wise prediction of pick success by a U-Net on depth and normals, its training and its file. Needs PyTorch.

It learns from tried pixels, from pixels without object as failures, and, where a data set has them, from analytic maps as an auxiliary
task. The camera looks straight down, and its principal point is the middle of the image, so a turned or
mirrored image shows a possible state: images, normals and grasp points are turned about the principal point at random.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch.nn import functional  # pyright: ignore[reportMissingImports]

from synpick_warp.errors import DatasetError
from tools.examples.picking_data import MAPS, Samples
from tools.examples.picking_scores import Sight, find_normals
from tools.examples.train_online import Network

LABELS = ("success", "intended")
"""Outcomes that the network predicts, in its first channels: any object picked; that of the pixel picked."""
EMPTY_PIXELS, EMPTY_WEIGHT = 64, 0.2
"""Negative samples of an image, drawn from pixels without object, and their weight in the loss against that of the trials."""
LEARNING_RATE, WARM_UP, DECAY, BATCH = 2e-3, 0.05, 1e-2, 16
TURNED = 0.5
"""Fraction of the training images that are turned by any angle; the others are only mirrored, which needs no interpolation."""
HINTS = 0.3
"""Factor on the auxiliary loss: prediction of the analytic maps, where a data set has them."""
SMOOTHING = 3
"""Side of the window over which predictions are averaged [px]: a pick lands within half a pixel of its target, and labels are sparse."""
SCALE = 10.0
"""Depth differences are given in units of 0.1 m."""


def make_inputs(sight: Sight) -> torch.Tensor:
    """Network input (B, 5, H, W): depth less the image's median [0.1 m], surface normals (3), and valid-depth mask."""
    known = (sight.depth > 0.0).float()
    middle = sight.depth.flatten(1).median(dim=1).values[:, None, None]
    parts = (((sight.depth - middle) * known * SCALE)[:, None], find_normals(sight.depth, sight.focal) * known[:, None], known[:, None])
    return torch.cat(parts, dim=1)


@dataclass(frozen=True, eq=False)
class Batches:
    """Training samples on a device; trials (state, trial) are padded to the same number by ones of weight 0."""

    inputs: torch.Tensor
    """Inputs of the network (state, 5, H, W)."""
    instance: torch.Tensor
    """Visible instances (state, 1, H, W) float32; 0: none."""
    maps: torch.Tensor | None
    """Analytic maps (state, 2, H, W) float16; None: there are none."""
    place: torch.Tensor
    """Grasp points about the principal point (state, trial, 2) float32 [px]."""
    target: torch.Tensor
    """LABELS of the trials (state, 2, trial) float32."""
    weight: torch.Tensor
    """Weights of the trials (state, trial) float32."""

    @classmethod
    def of(cls, samples: Samples, device: torch.device) -> Batches:
        """Copy samples to a device."""
        trials, states, state = samples.trials, len(samples.episode), samples.trials["state"]
        counts = np.bincount(state, minlength=states)
        column = np.arange(len(state)) - np.repeat(np.cumsum(counts) - counts, counts)
        height, width = samples.sight.depth.shape[1:]
        centers = np.stack((trials["x"] + 0.5 - width / 2, trials["y"] + 0.5 - height / 2), axis=1)
        shape = (states, max(1, int(counts.max(initial=0))))
        place, target, weight = np.zeros((*shape, 2)), np.zeros((states, len(LABELS), shape[1])), np.zeros(shape)
        place[state, column], weight[state, column] = centers, 1.0
        for channel, name in enumerate(LABELS):
            target[state, channel, column] = trials[name]
        depth, instance = samples.sight.depth, samples.sight.instance.to(device)[:, None].float()
        chunks = [Sight(part.to(device), part, samples.sight.focal) for part in depth.split(BATCH)]
        inputs = torch.cat([make_inputs(chunk) for chunk in chunks])
        maps = None if samples.maps is None else samples.maps.to(device)
        return cls(inputs, instance, maps, *(torch.from_numpy(values).float().to(device) for values in (place, target, weight)))

    def draw(self, count: int, generator: torch.Generator) -> Batches:
        """Draw states at random, and turn and mirror each about its principal point."""
        device = self.inputs.device
        chosen = torch.randint(len(self.inputs), (count,), generator=generator).to(device)
        angle = math.pi * torch.randint(2, (count,), generator=generator)
        turned = torch.rand(count, generator=generator) < TURNED
        angle = torch.where(turned, 2 * math.pi * torch.rand(count, generator=generator), angle)
        mirrored = 1.0 - 2.0 * torch.randint(2, (count,), generator=generator)
        cos, sin = angle.cos().round(decimals=6), angle.sin().round(decimals=6)
        matrix = torch.stack((torch.stack((mirrored * cos, -sin), 1), torch.stack((mirrored * sin, cos), 1)), 1).to(device)
        inputs = _turn(self.inputs[chosen], matrix, "bilinear")
        inputs[:, 1:3] = torch.einsum("bij,bjhw->bihw", matrix, inputs[:, 1:3])
        instance = _turn(self.instance[chosen], matrix, "nearest")
        maps = None if self.maps is None else _turn(self.maps[chosen].float(), matrix, "nearest")
        place = self.place[chosen] @ matrix.mT
        half = torch.tensor(inputs.shape[:1:-1], device=device) / 2
        weight = self.weight[chosen] * (place.abs() < half).all(dim=2)
        return Batches(inputs, instance, maps, place, self.target[chosen], weight)


def _grid(place: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Places about the image's middle (..., 2) [px] in the coordinates of `grid_sample`, from -1 to 1."""
    return place * place.new_tensor((2.0 / width, 2.0 / height))


def _turn(images: torch.Tensor, matrix: torch.Tensor, mode: str) -> torch.Tensor:
    """Images (B, C, H, W) after a turn of their content about the middle by orthogonal matrices (B, 2, 2); 0 beyond their border."""
    height, width = images.shape[2:]
    rows, columns = (torch.arange(size, device=images.device) + 0.5 - size / 2 for size in (height, width))
    place = torch.stack((columns.expand(height, width), rows[:, None].expand(height, width)), dim=-1).flatten(0, 1)
    grid = _grid(place @ matrix, height, width).view(len(images), height, width, 2)
    return functional.grid_sample(images, grid, mode=mode, align_corners=False)


def train(samples: Samples, width: int, steps: int, device: torch.device, seed: int = 0, batch: int = BATCH) -> tuple[Network, list[float]]:
    """Train a U-Net (AdamW, cosine decay) on trials; returns it and the loss of each step."""
    torch.manual_seed(seed)
    batches = Batches.of(samples, device)
    network = Network(len(LABELS) + len(MAPS), width, inputs=5).to(device)
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=DECAY)
    generator, losses = torch.Generator().manual_seed(seed), []
    for step in range(steps):
        done = step / steps
        factor = done / WARM_UP if done < WARM_UP else 0.5 + 0.5 * math.cos(math.pi * (done - WARM_UP) / (1 - WARM_UP))
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * max(factor, 0.01)
        drawn = batches.draw(min(batch, len(batches.inputs)), generator)
        loss = _loss(network(drawn.inputs), drawn)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
    return network.eval(), torch.stack(losses).tolist()


def _loss(output: torch.Tensor, drawn: Batches) -> torch.Tensor:
    """Binary cross entropy at tried pixels and negative samples, plus the auxiliary loss of the analytic maps on objects."""
    height, width = output.shape[2:]
    labels, cross_entropy = output[:, : len(LABELS)], functional.binary_cross_entropy_with_logits
    logit = functional.grid_sample(labels, _grid(drawn.place, height, width)[:, None], align_corners=False)[:, :, 0]
    each = cross_entropy(logit, drawn.target, reduction="none").mean(dim=1)
    loss = (drawn.weight * each).sum() / drawn.weight.sum().clamp(min=1.0)
    place = torch.rand(len(output), 1, EMPTY_PIXELS, 2, device=output.device) * 2 - 1
    empty = (functional.grid_sample(drawn.instance, place, mode="nearest", align_corners=False)[:, 0, 0] == 0).float()
    negative = functional.softplus(functional.grid_sample(labels, place, align_corners=False)[:, :, 0]).mean(dim=1)
    loss = loss + EMPTY_WEIGHT * (empty * negative).sum() / empty.sum().clamp(min=1.0)
    if drawn.maps is None:
        return loss
    visible = (drawn.instance > 0).expand_as(drawn.maps)
    hints = cross_entropy(output[:, len(LABELS) :][visible], drawn.maps[visible], reduction="sum")
    return loss + HINTS * hints / visible.sum().clamp(min=1)


def score_learned(network: torch.nn.Module, sight: Sight) -> torch.Tensor:
    """Probability predicted by the network (B, H, W), averaged over the four mirror images and a window: that any object is picked; with a
    target, that the pixel's own is."""
    channel = LABELS.index("success" if sight.target is None else "intended")
    with torch.no_grad():
        return torch.cat([_predict(network, sight.part(slice(at, at + BATCH)), channel) for at in range(0, len(sight.depth), BATCH)])


def _predict(network: torch.nn.Module, sight: Sight, channel: int) -> torch.Tensor:
    """Smoothed mean prediction of a channel over the mirror images."""
    total = torch.zeros_like(sight.depth)
    for axes in ((), (1,), (2,), (1, 2)):
        mirrored = Sight(sight.depth.flip(axes), sight.instance, sight.focal)
        total += network(make_inputs(mirrored))[:, channel].sigmoid().flip(axes) / 4
    return functional.avg_pool2d(total[:, None], SMOOTHING, 1, SMOOTHING // 2, count_include_pad=False)[:, 0]


def save_picker(path: Path, network: Network, width: int, size: tuple[int, int]) -> None:
    """Write a network's weights with its width and the size of its images."""
    torch.save({"width": width, "size": size, "weights": network.state_dict()}, path)


def load_picker(path: Path, device: torch.device) -> tuple[Network, dict[str, Any]]:
    """Read a file of `save_picker`: network and all its entries; raises DatasetError if it is no such file."""
    try:
        parts = torch.load(path, map_location=device, weights_only=True)
        network = Network(len(LABELS) + len(MAPS), parts["width"], inputs=5).to(device)
        network.load_state_dict(parts["weights"])
    except (OSError, EOFError, KeyError, TypeError, RuntimeError, ValueError, UnpicklingError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise DatasetError(f"{path} is no picker that `train` wrote: {reason}") from None
    return network.eval(), parts
