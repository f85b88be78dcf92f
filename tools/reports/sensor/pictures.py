"""Comparison pictures of measured and simulated depth: both, their difference, and their holes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import output_errors
from tools.reports.real_frames import RealFrame
from tools.reports.sensor.scene import METRES, Rendered

_RANGE = 10.0
"""Difference at the ends of the colour scale [mm]."""
_MEASURED_ONLY, _SIMULATED_ONLY, _BOTH = (60, 60, 230), (230, 130, 40), (255, 255, 255)
"""BGR of holes of one image, of the other, and of both."""


def write_pictures(folder: Path, frames: Sequence[RealFrame], rendered: Rendered) -> None:
    """Write sensor_SSSS.png of each sequence's first frame: measured | simulated above difference | holes.

    Difference: blue where measured depth is smaller by 10 mm or more, white 0, red where it is larger; black without depth in either.
    Holes, over the dimmed colour image: red those of the measured image alone, blue those of the simulated one alone, white both.
    """
    if not folder.is_dir():
        raise OutputError(f"--pictures is {folder}; allowed: a folder that exists")
    for sequence in sorted({frame.sequence for frame in frames}):
        row = next(row for row, frame in enumerate(frames) if frame.sequence == sequence)
        picture = draw_comparison(frames[row], rendered.sensor[row])
        path = folder / f"sensor_{sequence:04d}.png"
        with output_errors(path):
            path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def draw_comparison(frame: RealFrame, simulated: np.ndarray) -> np.ndarray:
    """Picture (2 H, 2 W, 3) uint8 BGR of a frame and its simulated depth (H, W) [0.1 mm]."""
    measured = frame.depth
    low, high = np.percentile(measured[measured > 0], (1, 95))
    off = np.where((measured > 0) & (simulated > 0), METRES * 1e3 * (measured.astype(np.float64) - simulated), np.nan)
    dim = cv2.cvtColor(frame.color // 3, cv2.COLOR_RGB2BGR)
    for color, where in (
        (_MEASURED_ONLY, (measured == 0) & (simulated > 0)),
        (_SIMULATED_ONLY, (measured > 0) & (simulated == 0)),
        (_BOTH, (measured == 0) & (simulated == 0)),
    ):
        dim[where] = color
    depths = [_color(image, low, high) for image in (measured, simulated)]
    return np.concatenate([np.concatenate(depths, axis=1), np.concatenate([_difference(off), dim], axis=1)])


def _color(counts: np.ndarray, low: float, high: float) -> np.ndarray:
    """Depth in false colours; black: a hole."""
    levels = (255.0 * np.clip((counts - low) / (high - low), 0.0, 1.0)).astype(np.uint8)
    return cv2.applyColorMap(levels, cv2.COLORMAP_TURBO) * (counts > 0)[..., None].astype(np.uint8)


def _difference(off: np.ndarray) -> np.ndarray:
    """Diverging colours of a difference (H, W) [mm]; NaN is black."""
    part = np.clip(np.nan_to_num(off) / _RANGE, -1.0, 1.0)[..., None]
    cold, warm = np.array((190, 110, 30)), np.array((40, 40, 200))
    color = 255.0 + np.where(part < 0.0, -part * (cold - 255.0), part * (warm - 255.0))
    return np.where(np.isnan(off)[..., None], 0, color).astype(np.uint8)
