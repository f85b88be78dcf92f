"""Amodal masks on the host: one bit per pixel of each instance's bounding box, in words of MASK_ROWS rows, as the renderer packs them."""

from __future__ import annotations

import numpy as np

from synpick_warp.codes import MASK_ROWS

WORD_BYTES = 4
"""Bytes of a word."""


def most_words(width: int, height: int) -> int:
    """Words of a mask as large as an image [px]."""
    return width * -(-height // MASK_ROWS)


def paint_masks(words: np.ndarray, first: np.ndarray, box: np.ndarray, width: int, height: int) -> np.ndarray:
    """Masks of a view as images (I, H, W) bool, from its words, the first of each mask (I) and the boxes (I, 4)."""
    masks = np.zeros((len(first), height, width), bool)
    for mask, index, (left, top, right, bottom) in zip(masks, first.tolist(), box.tolist(), strict=True):
        mask[top : bottom + 1, left : right + 1] = unpack_mask(words, index, np.array((left, top, right, bottom)))
    return masks


def unpack_mask(words: np.ndarray, first: int, box: np.ndarray) -> np.ndarray:
    """Mask of an instance within its box (rows, columns) bool.

    Args:
        words: Words of the view (W) uint32.
        first: Index of the first of this mask.
        box: x_min, y_min, x_max, y_max, inclusive [px]; x_max < x_min: empty.
    """
    columns, rows = (max(0, int(past) - int(start) + 1) for start, past in zip(box[:2], box[2:], strict=True))
    bands = -(-rows // MASK_ROWS)
    own = words[first : first + bands * columns].astype("<u4", copy=False).reshape(bands, columns, 1)
    bits = np.unpackbits(own.view(np.uint8), axis=-1, bitorder="little")
    return bits.swapaxes(1, 2).reshape(bands * MASK_ROWS, columns)[:rows].astype(bool)
