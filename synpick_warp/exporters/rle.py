"""Masks cut out of a view's images, and their run lengths: never by way of a file that is read again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Crop:
    """The part of a mask that can be True, and where it lies in the full image."""

    mask: np.ndarray
    """(h, w) bool; may have no pixels."""
    top: int
    """Row of the crop's first row in the full image."""
    left: int
    """Column of the crop's first column in the full image."""

    @property
    def count(self) -> int:
        """How many pixels are True."""
        return int(np.count_nonzero(self.mask))

    def box(self) -> tuple[int, int, int, int] | None:
        """x_min, y_min, x_max, y_max of the True pixels, inclusive; None: there are none."""
        rows = np.flatnonzero(self.mask.any(axis=1))
        if not rows.size:
            return None
        columns = np.flatnonzero(self.mask.any(axis=0))
        return self.left + int(columns[0]), self.top + int(rows[0]), self.left + int(columns[-1]), self.top + int(rows[-1])


def amodal_crop(amodal: np.ndarray, instance: int, box: np.ndarray) -> Crop:
    """The mask of an instance, hidden or not, from the bits (H, W) uint32 inside a box (4) that may exceed the image."""
    part, top, left = _cut(amodal, box)
    return Crop((part & np.uint32(1 << instance)) != 0, top, left)


def visible_crop(instances: np.ndarray, instance: int, box: np.ndarray) -> Crop:
    """The mask of an instance's visible part from the instance image (H, W) uint8 inside a box (4)."""
    part, top, left = _cut(instances, box)
    return Crop(part == np.uint8(1 + instance), top, left)


def _cut(image: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, int, int]:
    height, width = image.shape
    x_min, y_min, x_max, y_max = (int(value) for value in box)
    left, top = min(max(x_min, 0), width), min(max(y_min, 0), height)
    return image[top : max(min(y_max + 1, height), top), left : max(min(x_max + 1, width), left)], top, left


def run_lengths(crop: Crop, height: int, width: int) -> list[int]:
    """COCO's uncompressed run lengths of the full mask: down the columns, False first, in turn; they sum to height · width."""
    rows, columns = crop.mask.shape
    # One column of the mask after the other, each with a False at its foot, so that no run goes on into the next.
    line = np.zeros(columns * (rows + 1) + 1, bool)
    line[1:].reshape(columns, rows + 1)[:, :rows] = crop.mask.T
    column, row = np.divmod(np.flatnonzero(line[1:] != line[:-1]), rows + 1)
    changes = (crop.left + column) * height + crop.top + row
    if not changes.size:
        return [height * width]
    # If the crop is as high as the image, a run may go on after all.
    apart = changes[2::2] != changes[1:-1:2]
    edges = np.empty(2 * np.count_nonzero(apart) + 4, np.int64)
    edges[0], edges[-1] = 0, height * width
    edges[1:-1:2] = changes[::2][np.append(True, apart)]
    edges[2:-1:2] = changes[1::2][np.append(apart, True)]
    counts = np.diff(edges)
    return (counts if counts[-1] else counts[:-1]).tolist()
