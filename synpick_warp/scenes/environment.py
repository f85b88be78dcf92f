"""HDR environment maps: the equirectangular parameterization that all of them share, and resampling.

Row 0 looks up (+z); azimuth atan2(y, x) lies at the fraction u = azimuth / 2π + 0.5 of the width.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np

from synpick_warp.system.linear_algebra import DECIMALS

BACKGROUND_ROWS = 256
"""Rows of the background, which cameras see out of focus; 0.7° a texel is fine enough to tell lamps apart."""
WHITE_VALUE = 1.25
"""Auto-exposure target: display value (linear) of a white diffuse surface that faces up, under the unoccluded map."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Luminance weights of linear RGB (Rec. 709)."""


def map_directions(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (rows, 2 rows, 3) of a map's texel centres and their solid angles (rows, 2 rows) [sr], read-only.

    Results for up to `BACKGROUND_ROWS` rows are cached; those for larger maps would take too much memory.
    """
    return _cached_directions(rows) if rows <= BACKGROUND_ROWS else _compute_directions(rows)


def _compute_directions(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (rows, 2 rows, 3) and solid angles of an equirectangular map's pixels, read-only; uncached `map_directions`."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5) * 2.0 * np.pi
    (down, out), (x, y) = (np.round([np.cos(angle), np.sin(angle)], DECIMALS) for angle in (polar, azimuth))
    directions = np.stack([np.outer(out, x), np.outer(out, y), np.repeat(down[:, None], 2 * rows, axis=1)], axis=-1)
    edges = np.cos(np.arange(rows + 1) / rows * np.pi).round(DECIMALS)
    solid_angles = np.repeat((edges[:-1] - edges[1:])[:, None], 2 * rows, axis=1) * (2.0 * np.pi / (2 * rows))
    for values in (directions, solid_angles):
        values.setflags(write=False)
    return directions, solid_angles


_cached_directions = functools.cache(_compute_directions)


def resize_map(radiance: np.ndarray, rows: int) -> np.ndarray:
    """Resample a map to `rows` rows and twice as many columns: by area where it shrinks, so that energy is kept; float64."""
    if rows <= radiance.shape[0]:
        return cv2.resize(radiance.astype(np.float32), (2 * rows, rows), interpolation=cv2.INTER_AREA).astype(np.float64)
    return _interpolate(_interpolate(radiance.astype(np.float64), rows, 0), 2 * rows, 1)


def _interpolate(values: np.ndarray, count: int, axis: int) -> np.ndarray:
    """Linear interpolation along an axis, from centre to centre; OpenCV's, by Intel's IPP, depends on the processor."""
    at = ((np.arange(count) + 0.5) * (values.shape[axis] / count) - 0.5).clip(0, values.shape[axis] - 1)
    low = at.astype(int)
    high, share = (
        np.minimum(low + 1, values.shape[axis] - 1),
        (at - low).reshape([-1 if each == axis else 1 for each in range(values.ndim)]),
    )
    return values.take(low, axis) * (1.0 - share) + values.take(high, axis) * share
