"""NumPy twin of amodal masks in boxes: packed from mask images, and unpacked to these pixel by pixel."""

from typing import Any

import numpy as np

from synpick_warp.codes import MASK_ROWS as ROWS
from synpick_warp.testing.box_views import pack_masks


def pack_into(buffers: Any, masks: np.ndarray) -> None:
    """Assign masks (B, I, H, W) bool to `ViewBuffers`."""
    packed = [pack_masks(view) for view in masks]
    for name in packed[0]:
        getattr(buffers, name).assign(np.stack([view[name] for view in packed]))


def unpack_view(views: Any, view: int, height: int, width: int) -> np.ndarray:
    """Unpack the instance masks (I, H, W) bool of one view from a `FrameBatch`, or from `ViewBuffers` copied to the host."""
    words, first, box = (np.asarray(getattr(views, name)[view]) for name in ("mask_words", "mask_first", "mask_box"))
    masks = np.zeros((len(first), height, width), bool)
    for index, (left, top, right, bottom) in enumerate(box.tolist()):
        rows, columns = np.mgrid[top : bottom + 1, left : right + 1]
        place = first[index] + (rows - top) // ROWS * (right - left + 1) + columns - left
        masks[index, top : bottom + 1, left : right + 1] = words[place] >> ((rows - top) % ROWS).astype(np.uint32) & 1
    return masks


def masks_of_batch(batch: Any, view: int = 0) -> np.ndarray:
    """Masks (I, H, W) bool of a view of a `FrameBatch`."""
    return unpack_view(batch, view, *batch.instance[view].shape)


def masks_of_buffers(buffers: Any) -> np.ndarray:
    """Masks (B, I, H, W) bool of `ViewBuffers`."""
    views, height, width = buffers.instance.shape
    host = type("Host", (), {name: getattr(buffers, name).numpy() for name in ("mask_words", "mask_first", "mask_box")})
    return np.stack([unpack_view(host, view, height, width) for view in range(views)])


def bits_of(masks: np.ndarray) -> np.ndarray:
    """Bit i: instance i (..., H, W) uint32, from masks (..., I, H, W) bool of at most 32 instances."""
    bits = np.uint32(1) << np.arange(masks.shape[-3], dtype=np.uint32)
    return (masks * bits[:, None, None]).sum(axis=-3).astype(np.uint32)
