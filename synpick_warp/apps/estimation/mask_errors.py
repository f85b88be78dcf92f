"""Mask errors as a segmentation makes them: eroded, dilated, or swapped with a neighbour; on label images."""

from __future__ import annotations

import cv2
import numpy as np

from synpick_warp.apps.estimation.draws import Draw, sample_uniform

FRACTION = 0.05
"""Expected fraction of the instances of each kind of error."""
RADIUS = 0.05
"""Radius of erosion and dilation, as a fraction of the square root of the visible area: a square loses 19 % of its area, or gains 21 %
without its corners' rounding."""
MIN_RADIUS = 1.0
"""[px]"""


def disturb_labels(label: np.ndarray, boxes: np.ndarray, instances: np.ndarray, seed: int, scene: int, frame: int) -> None:
    """Change the masks of random instances of an image, in place.

    An instance is eroded with probability FRACTION, dilated with FRACTION, and begins a swap with half of FRACTION, since a swap exchanges
    the masks of two. The partner is drawn from the visible neighbours that were not swapped yet; without one the mask stays. Swaps come
    first, by slot; an instance that was chosen for an error of its own may be a partner, and its new mask is eroded or dilated.

    Args:
        label: Label image (H, W) uint8: 1 + slot, the index of an instance in the scene's arrays.
        boxes: Visible boxes (S, 4) [px] by slot: x, y, width, height as BOP has them; negative sizes: nothing is visible.
        instances: Instance index by slot (S,), which names the random samples.
        seed: Seed of the estimation.
        scene: Index of the scene.
        frame: Index of the image in the scene.
    """
    samples = sample_uniform(seed, scene, frame, Draw.MASK_ERROR, instances, 2)
    visible = boxes[:, 2] >= 0
    swapped: set[int] = set()
    for slot in np.flatnonzero(visible & (samples[:, 0] >= 2 * FRACTION) & (samples[:, 0] < 2.5 * FRACTION)).tolist():
        partners = [other for other in neighbours(boxes, slot).tolist() if visible[other] and other not in swapped]
        if partners and slot not in swapped:
            partner = partners[int(samples[slot, 1] * len(partners))]
            swap_masks(label, slot, partner)
            swapped |= {slot, partner}
    for slot in np.flatnonzero(visible & (samples[:, 0] < 2 * FRACTION)).tolist():
        resize_mask(label, slot, grow=bool(samples[slot, 0] >= FRACTION))


def neighbours(boxes: np.ndarray, slot: int) -> np.ndarray:
    """Slots of other instances whose visible boxes (S, 4) touch or overlap that of an instance; boxes include their last pixel."""
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    touching = ((low <= high[slot] + 1) & (low[slot] <= high + 1)).all(axis=1) & (boxes[:, 2] >= 0)
    touching[slot] = False
    return np.flatnonzero(touching)


def swap_masks(label: np.ndarray, first: int, second: int) -> None:
    """Exchange the masks of two slots in a label image, in place."""
    table = np.arange(256, dtype=np.uint8)
    table[[1 + first, 1 + second]] = 1 + second, 1 + first
    cv2.LUT(label, table, dst=label)


def resize_mask(label: np.ndarray, slot: int, *, grow: bool) -> None:
    """Dilate or erode a slot's mask in place, by thresholding the Euclidean distance transform at RADIUS times the root of the area.

    Dilation overwrites neighbouring masks; erosion keeps at least the innermost pixels.
    """
    mask = (label == 1 + slot).view(np.uint8)
    left, top, width, height = cv2.boundingRect(mask)
    if not width:
        return
    radius = max(MIN_RADIUS, RADIUS * float(np.sqrt(cv2.countNonZero(mask))))
    margin = 1 + int(np.ceil(radius))
    rows = slice(max(0, top - margin), min(label.shape[0], top + height + margin))
    columns = slice(max(0, left - margin), min(label.shape[1], left + width + margin))
    crop, part = mask[rows, columns], label[rows, columns]
    if grow:
        part[cv2.distanceTransform(1 - crop, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= radius] = 1 + slot
        return
    # Distance to the nearest pixel outside; the image's border is none.
    distance = cv2.distanceTransform(crop, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    part[(crop > 0) & (distance <= min(radius, 0.999 * float(distance.max())))] = 0
