"""NumPy twin of pixel counts and bounding boxes, computed from full images."""

from __future__ import annotations

import numpy as np


def box_of(mask: np.ndarray, origin: tuple[int, int] = (0, 0)) -> tuple[int, int, int, int]:
    """x_min, y_min, x_max, y_max, inclusive, of a mask whose first pixel has column and row `origin`; (0, 0, -1, -1) if empty."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return 0, 0, -1, -1
    left, top = origin
    return int(columns.min()) + left, int(rows.min()) + top, int(columns.max()) + left, int(rows.max()) + top


def count_pixels(instance: np.ndarray, depth: np.ndarray, masks: np.ndarray, canvas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Expected pixel counts and boxes of one view.

    Args:
        instance: Segmentation ids (H, W).
        depth: Counts (H, W).
        masks: Amodal masks (I, H, W) bool.
        canvas: Amodal masks (I, 3H, 3W) bool, with the image in the middle.

    Returns:
        px_count_all, px_count_valid, px_count_visib (I, 3); bbox_obj and bbox_visib (I, 2, 4).
    """
    height, width = instance.shape
    pixels, boxes = np.zeros((len(masks), 3), int), np.zeros((len(masks), 2, 4), int)
    for i, (full, inside) in enumerate(zip(canvas, masks, strict=True)):
        visible = instance == 1 + i
        pixels[i] = full.sum(), (inside & (depth != 0)).sum(), visible.sum()
        boxes[i] = box_of(full, (-width, -height)), box_of(visible)
    return pixels, boxes
