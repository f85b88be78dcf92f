"""Colour maps of depth (TURBO), on one scale for all pictures that stand beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import Image
from synpick_warp.configs.schema import Tote

_RANGE = (1.0, 99.0)
"""Percentiles of the depths that map to the first and the last colour, where no tote gives the range."""
_EVERY = 7
"""Every n-th pixel counts for percentiles."""
MM = 1000.0
"""Millimetres in a metre."""


class DepthScale(NamedTuple):
    """Colour scale of depth: the depths of the first (near) and the last colour (far) [mm]."""

    near: float
    far: float


def tote_scale(tote: Tote, cameras: Iterable[Mapping[str, Any]]) -> DepthScale | None:
    """Depths from the nearest corner of the tote's rim to the farthest of its floor, over some cameras; None: a camera has no pose.

    Args:
        tote: Settings of the tote.
        cameras: Records of scene_camera.json; their world is the tote's frame: origin in the middle of the inner floor, z up.
    """
    depths = []
    for camera in cameras:
        if "cam_R_w2c" not in camera or "cam_t_w2c" not in camera:
            return None
        axis, offset = np.array(camera["cam_R_w2c"][6:9], float), float(camera["cam_t_w2c"][2])
        depths.append(_corners(tote) @ axis * MM + offset)
    if not depths:
        return None
    near, far = float(np.min(depths)), float(np.max(depths))
    return DepthScale(near, far) if 0.0 < near < far else None


def _corners(tote: Tote) -> np.ndarray:
    """Corners of the inner floor and of the rim (8, 3) [m]."""
    levels = ((tote.floor_size, 0.0), (tote.rim_size, tote.outer_size[2] - tote.wall))
    return np.array([(x * w / 2, y * h / 2, z) for (w, h), z in levels for x, y in product((-1, 1), repeat=2)])


def pooled_scale(depths: Iterable[np.ndarray]) -> DepthScale | None:
    """Percentiles of all known depths of some images [mm]; None: no surface."""
    known = [depth.ravel()[::_EVERY][depth.ravel()[::_EVERY] > 0] for depth in depths]
    together = np.concatenate(known) if known else np.empty(0)
    if not together.size:
        return None
    near, far = np.percentile(together, _RANGE)
    return DepthScale(float(near), float(far))


def describe_depth(scale: DepthScale | None) -> str:
    """Caption of `color_depth`: the depths of the first and the last colour."""
    return "depth: none" if scale is None else f"depth {scale.near / MM:.3f} (red) to {scale.far / MM:.3f} m (blue); black: none"


def color_depth(depth: np.ndarray, scale: DepthScale | None = None) -> Image:
    """Depth as a TURBO colour map, near red, far blue, no surface black; without a scale that of the image itself."""
    near, far = scale or pooled_scale([depth]) or (0.0, 1.0)
    nearness = np.clip((far - depth) / max(far - near, 1e-9), 0.0, 1.0)
    colored = cv2.applyColorMap(np.rint(255 * nearness).astype(np.uint8), cv2.COLORMAP_TURBO)
    colored[depth == 0] = 0
    return colored
