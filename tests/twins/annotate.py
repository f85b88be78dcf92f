"""NumPy twin of pixel counts and bounding boxes, computed from full images of a camera and of one that sees beyond its border."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp

from synpick_warp.scenes.types import Camera
from tests.worlds.toy_scene import RenderedViews, ToyScene, render


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


def canvas_of(view: Camera) -> Camera:
    """The same camera with an image three times as wide and high, centred on the original."""
    matrix, size = view.matrix.copy(), (3 * view.width, 3 * view.height)
    matrix[:2, 2] += view.width, view.height
    lens = view.lens.cropped(-view.width, -view.height, size) if view.lens else None
    return replace(view, width=size[0], height=size[1], matrix=matrix, lens=lens)


def annotated(toy: ToyScene, device: wp.Device) -> tuple[RenderedViews, np.ndarray, np.ndarray]:
    """A scene rendered by its camera, and what its pixel counts and boxes must be."""
    picture, canvas = (render(replace(toy, cameras=(view,)), device, colors=False) for view in (toy.cameras[0], canvas_of(toy.cameras[0])))
    return picture, *count_pixels(picture.instance[0], picture.depth[0], picture.masks[0], canvas.masks[0])
