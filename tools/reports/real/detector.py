"""Faster R-CNN (Ren et al., NeurIPS 2015) of torchvision, from scratch, trained on a pool of views; AP at an IoU of 0.5 on real frames."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from tools.reports.real.training import MAX_NORM, Recipe, jitter_views
from tools.reports.real.views import Pool

RATE, MOMENTUM, DECAY = 0.02, 0.9, 1e-4
"""SGD as of Mask R-CNN (He et al., ICCV 2017)."""
MIN_SIDE = 6
"""Least width and height of a box that is trained on [px]."""
WARM_UP = 0.05
"""Fraction of the training in which the learning rate rises linearly."""
DECAYED = 0.7
"""Fraction of the training after which the learning rate is divided by 10."""
MIN_HEIGHT = 480
"""Minimum height of the detector's input [px], that of the photographs; lower images are upsampled. Its smallest anchors have 32 px."""


def boxes_of(labels: torch.Tensor, classes: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Bounding boxes of the objects in label images (B, H, W) of obj_ids below `classes`; 0 is the background.

    Returns, for each image, boxes (N, 4) float32 [px] with exclusive maxima and their obj_ids (N) int64, on the device of the images. Boxes
    with a side shorter than MIN_SIDE are left out.
    """
    ids = torch.arange(1, classes, device=labels.device)
    held = labels[:, None] == ids[:, None, None]
    rows, columns = held.any(3), held.any(2)
    (left, right), (top, bottom) = _extent(columns), _extent(rows)
    large = rows.any(2) & (torch.minimum(right - left, bottom - top) >= MIN_SIDE)
    boxes = torch.stack((left, top, right, bottom), 2).float()
    return [(found[kept], ids[kept]) for found, kept in zip(boxes, large, strict=True)]


def _extent(occupied: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Extent of the true elements of a boolean tensor along its last dimension: index of the first, and of the last plus one. Undefined
    where there are none."""
    values = occupied.byte()
    return values.argmax(-1), values.shape[-1] - values.flip(-1).argmax(-1)


def train_detector(pool: Pool, classes: int, device: torch.device, seconds: float, batch: int = 16) -> Any:
    """Train Faster R-CNN on the views of a pool for a given time [s]; returns None if torchvision is not installed or does not load.

    Steps with a non-finite gradient are skipped and counted, as they would turn all weights into NaN.
    """
    try:
        from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_fpn  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError, RuntimeError):  # RuntimeError: torchvision was built for another PyTorch.
        return None
    views, classified = pool.tensors()
    height, width = views.shape[2:]
    factor = max(1.0, MIN_HEIGHT / height)
    network = fasterrcnn_mobilenet_v3_large_fpn(
        weights=None,
        weights_backbone=None,
        num_classes=classes,
        trainable_backbone_layers=6,
        min_size=round(factor * height),
        max_size=round(factor * width),
    ).to(device)
    optimizer = torch.optim.SGD(network.parameters(), RATE, momentum=MOMENTUM, weight_decay=DECAY)
    started, random, steps, skipped = time.perf_counter(), np.random.default_rng(pool.seed), 0, 0
    while (done := (time.perf_counter() - started) / seconds) < 1.0:
        optimizer.param_groups[0]["lr"] = RATE * min(1.0, done / WARM_UP) * (1.0 if done < DECAYED else 0.1)
        chosen = random.integers(pool.count, size=batch).tolist()
        truth = [{"boxes": boxes, "labels": ids} for boxes, ids in boxes_of(classified[chosen], classes)]
        images = jitter_views(views[chosen, :3].float() / 255, Recipe.jitter)
        losses = network(list(images), truth)
        optimizer.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        finite = bool(torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_NORM).isfinite())
        if finite:
            optimizer.step()
        steps, skipped = steps + 1, skipped + (not finite)
    print(f"detector: {steps} steps, {skipped} of them skipped because of a non-finite gradient")
    return network.eval()


def detect(network: Any, color: np.ndarray, size: tuple[int, int], device: torch.device) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Detections in an image (H, W, 3) uint8 that the network sees at `size` (width, height): boxes (N, 4) [px of `color`], obj_ids (N),
    confidences (N)."""
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    with torch.no_grad():
        (found,) = network([torch.from_numpy(small).permute(2, 0, 1).float().div(255).to(device)])
    scale = np.array([color.shape[1] / size[0], color.shape[0] / size[1]] * 2)
    boxes, ids, confidence = (found[name].cpu().numpy() for name in ("boxes", "labels", "scores"))
    return boxes * scale, ids, confidence


def average_precision(found: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], truth: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Average precision at an IoU of 0.5, the area under the interpolated curve (PASCAL VOC 2010), averaged over the objects that occur.

    Args:
        found: Of each image, detections as of `detect`.
        truth: Of each image, boxes (N, 4) [px] and obj_ids (N).
    """
    values = []
    for index in sorted({int(one) for _, ids in truth for one in ids}):
        hits: list[tuple[float, bool]] = []
        for (boxes, ids, confidence), (true_boxes, true_ids) in zip(found, truth, strict=True):
            free = list(true_boxes[true_ids == index])
            order = np.flatnonzero(ids == index)
            for one in order[np.argsort(-confidence[order])]:
                overlaps = [_overlap(boxes[one], box) for box in free]
                hit = bool(overlaps) and max(overlaps) >= 0.5
                if hit:
                    free.pop(int(np.argmax(overlaps)))
                hits.append((float(confidence[one]), hit))
        count = sum(int((ids == index).sum()) for _, ids in truth)
        correct = np.cumsum([hit for _, hit in sorted(hits, key=lambda one: -one[0])])
        precision = correct / np.arange(1, len(correct) + 1)
        envelope = np.maximum.accumulate(precision[::-1])[::-1] if len(correct) else precision
        values.append(float(np.sum(envelope * np.diff(np.concatenate([[0], correct])) / count)))
    return float(np.mean(values)) if values else float("nan")


def _overlap(first: np.ndarray, second: np.ndarray) -> float:
    """IoU of two boxes."""
    low, high = np.maximum(first[:2], second[:2]), np.minimum(first[2:], second[2:])
    common = float(np.prod(np.maximum(high - low, 0)))
    areas = float(np.prod(first[2:] - first[:2]) + np.prod(second[2:] - second[:2]))
    return common / max(areas - common, 1e-9)
