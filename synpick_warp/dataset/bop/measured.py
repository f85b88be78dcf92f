"""Entries of scene_gt_info.json, measured from masks as the BOP toolkit does (calc_gt_info.py), for data sets that lack the file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

HIDDEN_BOX = [-1, -1, -1, -1]
UNKNOWN: dict[str, Any] = {
    "bbox_obj": HIDDEN_BOX,
    "bbox_visib": HIDDEN_BOX,
    "px_count_all": 0,
    "px_count_valid": 0,
    "px_count_visib": 0,
    "visib_fract": math.nan,
}
"""Entry of an instance without scene_gt_info.json and masks: visible fraction NaN says that nothing is known, not that it is hidden."""


def measure_info(visible: Sequence[np.ndarray], amodal: Sequence[np.ndarray] | None) -> list[dict[str, Any]]:
    """Measure pixel counts, visible fraction and boxes.

    Args:
        visible: Mask of each instance's visible part (H, W) bool.
        amodal: Mask of its silhouette within the image; None: there are none, and what is measured in them stays unknown.

    Returns:
        An entry for each instance; `px_count_valid`, which needs depth, is that of all pixels.
    """
    silhouettes = [None] * len(visible) if amodal is None else amodal
    return [_measure(*pair) for pair in zip(visible, silhouettes, strict=True)]


def _measure(visible: np.ndarray, amodal: np.ndarray | None) -> dict[str, Any]:
    """Record of scene_gt_info.json from masks (H, W) bool; without an amodal one (None) only what is visible is known."""
    seen = int(np.count_nonzero(visible))
    entry = UNKNOWN | {"bbox_visib": _box(visible), "px_count_visib": seen}
    if amodal is None:
        return entry
    everything = int(np.count_nonzero(amodal))
    return entry | {
        "bbox_obj": _box(amodal) if seen else HIDDEN_BOX,
        "px_count_all": everything,
        "px_count_valid": everything,
        "visib_fract": min(1.0, seen / everything) if everything else 0.0,
    }


def _box(mask: np.ndarray) -> list[int]:
    """Box of a mask as BOP has it: x_min, y_min, x_max - x_min, y_max - y_min [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return list(HIDDEN_BOX)
    return [int(columns[0]), int(rows[0]), int(columns[-1] - columns[0]), int(rows[-1] - rows[0])]
