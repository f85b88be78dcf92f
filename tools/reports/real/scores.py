"""Scores of semantic segmentation on annotated views: IoU over all views (PASCAL VOC; Everingham et al., 2010), of instances, background.

Each class is there once in a view, so an instance is the pixels of its class. Predictions are those of the network at its own size; logits
are upsampled to the size of the labels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]
from torch.nn import functional  # pyright: ignore[reportMissingImports]

from tools.reports.real.views import ViewPool

FOUND_IOU = 0.5
"""IoU above which an instance counts as found."""
MIN_PIXELS = 20
"""Pixels of the network's image below which an instance of a synthetic view is not counted."""
SCORED = 16
"""Views of a pool that are scored together."""


@dataclass(frozen=True, eq=False)
class NetworkScores:
    """Scores of a network on annotated views."""

    iou: dict[int, float]
    """IoU over all views of each object that occurs, by obj_id."""
    instances: tuple[tuple[str, int, float], ...]
    """View, obj_id and IoU of each instance."""
    background: float
    """Share of the background's pixels that are taken for objects."""
    views: dict[str, float]
    """Mean IoU of a view's instances, by its name."""

    @property
    def mean_iou(self) -> float:
        """IoU averaged over the objects that occur."""
        return float(np.mean(list(self.iou.values()))) if self.iou else float("nan")

    @property
    def found(self) -> float:
        """Share of instances with an IoU above FOUND_IOU."""
        return float(np.mean([iou > FOUND_IOU for _, _, iou in self.instances])) if self.instances else float("nan")


def predict(network: nn.Module, color: np.ndarray, size: tuple[int, int], device: torch.device) -> np.ndarray:
    """Segmentation of an image (H, W, 3) uint8, which the network sees at `size` (width, height): obj_id of each pixel (H, W) uint8."""
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    image = torch.from_numpy(np.ascontiguousarray(small.transpose(2, 0, 1)))[None]
    with torch.no_grad():
        logits = functional.interpolate(network(image.to(device)).float(), size=color.shape[:2], mode="bilinear", align_corners=False)
    return logits[0].argmax(0).to(torch.uint8).cpu().numpy()


def score(predictions: Iterable[tuple[str, np.ndarray, np.ndarray]], classes: int, least: int = 1) -> NetworkScores:
    """Scores of predictions: name of the view, predicted and true obj_ids (H, W) uint8; `least`: pixels of an instance that counts."""
    total, instances = np.zeros((classes, classes), np.int64), []
    views: dict[str, float] = {}
    for name, found, truth in predictions:
        table = np.bincount(truth.astype(np.int64).ravel() * classes + found.ravel(), minlength=classes**2).reshape(classes, classes)
        total += table
        ious = _ious(table)
        here = [(name, index, float(ious[index])) for index in range(1, classes) if table[index].sum() >= least]
        instances += here
        if here:
            views[name] = float(np.mean([iou for _, _, iou in here]))
    ious, occurs = _ious(total), total.sum(axis=1) > 0
    background = float(total[0, 1:].sum() / max(1, total[0].sum()))
    return NetworkScores({index: float(ious[index]) for index in range(1, classes) if occurs[index]}, tuple(instances), background, views)


def _ious(table: np.ndarray) -> np.ndarray:
    """IoU of each class of a confusion table (truth, prediction)."""
    union = table.sum(0) + table.sum(1) - table.diagonal()
    return table.diagonal() / np.maximum(union, 1)


def score_pool(network: nn.Module, pool: ViewPool, classes: int) -> NetworkScores:
    """Scores of a network on the views of a pool, at their own size."""
    images, classified = pool.tensors()

    def pairs() -> Iterable[tuple[str, np.ndarray, np.ndarray]]:
        for start in range(0, pool.count, SCORED):
            part = slice(start, min(start + SCORED, pool.count))
            with torch.no_grad():
                found = network(images[part]).argmax(1)
            both = zip(found.to(torch.uint8).cpu().numpy(), classified[part].cpu().numpy(), strict=True)
            yield from ((str(start + index), one, truth) for index, (one, truth) in enumerate(both))

    return score(pairs(), classes, MIN_PIXELS)


def _palette(classes: int) -> np.ndarray:
    """Palette (classes, 3) uint8, RGB, of different hues; black for the background."""
    hues = (np.arange(classes) * 67 % 180).astype(np.uint8)
    values = np.stack([hues, np.full(classes, 220, np.uint8), np.where(np.arange(classes) % 2, 255, 190).astype(np.uint8)], axis=-1)
    colors = cv2.cvtColor(values[None], cv2.COLOR_HSV2RGB)[0]
    colors[0] = 0
    return colors


def draw_overlay(path: Path, rows: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], classes: int, width: int = 240) -> None:
    """Write a contact sheet (PNG) with a column of `width` px for each view: image, and truth and prediction laid over it."""
    palette, columns = _palette(classes), []
    for color, truth, found in rows:
        height = round(color.shape[0] * width / color.shape[1])
        layers = [color, *(cv2.addWeighted(color, 0.45, palette[ids], 0.55, 0) for ids in (truth, found))]
        columns.append(np.vstack([cv2.resize(layer, (width, height), interpolation=cv2.INTER_AREA) for layer in layers]))
    cv2.imwrite(str(path), np.hstack(columns)[..., ::-1])
