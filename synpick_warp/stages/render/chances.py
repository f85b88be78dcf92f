"""Tables for drawing directions by how bright a light map is there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting.sampling import Chances
from synpick_warp.scenes.environment import LUMINANCE, map_directions

LOW_SHARE = 0.15
"""How much light from the horizon counts; light from the zenith counts 1 more."""


@dataclass(frozen=True, eq=False)
class ChanceTable:
    """Cumulative chances of one light map's texels; see `kernels.render.lighting.sampling.Chances`."""

    row: np.ndarray
    """(rows + 1) float32."""
    column: np.ndarray
    """(rows, columns + 1) float32."""


def chance_table(radiance: np.ndarray, table: bool = False) -> ChanceTable:
    """Chances of a map's texels: luminance times solid angle, evenly where there is none.

    What lies low counts less, since most surfaces that light can reach face up and totes have walls; with a table, what lies below
    the horizon counts nothing, since nothing sees it.

    The map is seen through bilinear interpolation, which carries light half a texel beyond a lamp's edge: a texel counts
    with the mean of what is seen there, so that no light lies where the chance is 0.

    Args:
        radiance: (rows, 2 rows, 3).
        table: Whether a table hides the map below the horizon.
    """
    rows, columns = radiance.shape[:2]
    directions, solid = map_directions(rows)
    height = directions[..., 2]
    share = np.where(height > 0.0, height, 0.0) + LOW_SHARE
    if table:
        # The texels next to the horizon reach below it.
        share[height < -np.pi / rows] = 0.0
    bright = radiance.astype(np.float64) @ LUMINANCE
    # The mean over a texel of what is interpolated linearly: 1/8, 3/4, 1/8.
    bright = 0.75 * bright + 0.125 * (np.roll(bright, 1, axis=1) + np.roll(bright, -1, axis=1))
    padded = np.pad(bright, ((1, 1), (0, 0)), mode="edge")
    weight = (0.75 * bright + 0.125 * (padded[:-2] + padded[2:])) * solid * share
    if weight.sum() <= 0.0:
        weight = solid * share
    column = np.zeros((rows, columns + 1))
    column[:, 1:] = np.cumsum(np.where(weight.sum(axis=1, keepdims=True) > 0.0, weight, 1.0), axis=1)
    row = np.concatenate([[0.0], np.cumsum(weight.sum(axis=1))])
    return ChanceTable((row / row[-1]).astype(np.float32), (column / column[:, -1:]).astype(np.float32))


def build_chances(background: np.ndarray, device: wp.Device, table: bool = False) -> Any:
    """The struct `Chances` of light maps (map, rows, 2 rows, 3); `table`: whether a table hides them below the horizon."""
    tables = [chance_table(radiance, table) for radiance in background]
    chances = Chances()
    chances.row = wp.array(np.stack([table.row for table in tables]), dtype=wp.float32, device=device)
    chances.column = wp.array(np.stack([table.column for table in tables]), dtype=wp.float32, device=device)
    return chances
