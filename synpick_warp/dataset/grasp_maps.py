"""Simulated picks as a view shows them: pixels of grasp points, success at tried pixels, arrays of suctionnetAPI."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from synpick_warp.dataset.view import View


def mean_by_candidate(picks: np.ndarray, name: str = "success") -> tuple[np.ndarray, np.ndarray]:
    """Candidates of trials, and the mean of a column over the repeats of each.

    Returns:
        The first trial of each candidate (candidate) int64, and the means (candidate) float64.
    """
    _, first, which = np.unique(picks[["state", "candidate"]], return_index=True, return_inverse=True)
    return first, np.bincount(which, picks[name], len(first)) / np.bincount(which, minlength=len(first))


def candidates(picks: np.ndarray) -> np.ndarray:
    """The first trial of each candidate, with the columns of a trial, in the order of `mean_by_candidate`."""
    return picks[mean_by_candidate(picks)[0]]


def find_pixels(view: View, picks: np.ndarray) -> np.ndarray:
    """Pixels (column, row) of grasp points in a view (trial, 2) int64; they may be hidden, or outside of the image."""
    return np.floor(view.project(picks["point"], view.world_to_camera)).astype(np.int64)


def graspable_map(view: View, picks: np.ndarray, hides: bool) -> np.ndarray:
    """Simulated success at tried pixels (H, W) float32: share of the trials there that held an object; NaN: none was tried.

    Args:
        view: The view.
        picks: Trials from its frame.
        hides: Whether grasp points can be hidden, as the view is not of the camera that saw them; NaN there, too.
    """
    width, height = view.size
    result = np.full((height, width), np.nan, np.float32)
    if not len(picks):
        return result
    pixels = find_pixels(view, picks)
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    flat, which = np.unique(pixels[inside, 0] + width * pixels[inside, 1], return_inverse=True)
    means = np.bincount(which, picks["success"][inside], len(flat)) / np.bincount(which, minlength=len(flat))
    result.ravel()[flat] = means
    for instance in np.unique(picks["instance"]).tolist() if hides else ():
        own = np.unique(flat[which[picks["instance"][inside] == instance]])
        shown = view.masks[view.instance_ids == instance].any(axis=0).ravel()[own]
        result.ravel()[own[~shown]] = np.nan
    return result


def suction_group(view: View, picks: np.ndarray) -> np.ndarray:
    """Candidates as an array of suctionnetAPI (candidate, 7) float32: share of successful trials, direction (outward normal) and
    translation (grasp point) [m] in the camera frame."""
    first, success = mean_by_candidate(picks)
    rotation, offset = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    rows = (success, picks["normal"][first] @ rotation.T, picks["point"][first] @ rotation.T + offset)
    return np.column_stack(rows).astype(np.float32)
