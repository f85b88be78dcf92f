"""Simulated picks in image and camera coordinates: pixels of grasp points, success maps, arrays of suctionnetAPI."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from synpick_warp.dataset.view import View


def mean_by_candidate(picks: np.ndarray, name: str = "success") -> tuple[np.ndarray, np.ndarray]:
    """Group trials by candidate: the first trial of each, and the mean of a column over its repeats.

    Returns:
        Index of the first trial of each candidate (candidate) int64, and means (candidate) float64.
    """
    _, first, which = np.unique(picks[["state", "candidate"]], return_index=True, return_inverse=True)
    return first, np.bincount(which, picks[name], len(first)) / np.bincount(which, minlength=len(first))


def candidates(picks: np.ndarray) -> np.ndarray:
    """The first trial of each candidate, with the columns of a trial, in the order of `mean_by_candidate`."""
    return picks[mean_by_candidate(picks)[0]]


def find_pixels(view: View, picks: np.ndarray) -> np.ndarray:
    """Project grasp points to pixels of a view: column, row (trial, 2) int64; points may be hidden, or outside of the image."""
    return np.floor(view.project(picks["point"], view.world_to_camera)).astype(np.int64)


def graspable_map(view: View, picks: np.ndarray, hides: bool) -> np.ndarray:
    """Sparse success map (H, W) float32: share of the trials at a pixel that held an object; NaN: not tried.

    Args:
        view: The view.
        picks: Trials from its frame.
        hides: Whether to leave out (NaN) grasp points that the view does not show: for other cameras than the candidates'.
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
