"""Colour maps of depth (TURBO), on one scale for all pictures that stand beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import Image
from synpick_warp.configs.cell.extents import BinSizes

_RANGE = (1.0, 99.0)
"""Percentiles of the depths that map to the first and the last colour, where no bin gives the range."""
_EVERY = 7
"""Every n-th pixel counts for percentiles."""
MM = 1000.0
"""Millimetres in a metre."""


class DepthScale(NamedTuple):
    """Colour scale of depth: the depths of the first (near) and the last colour (far) [mm]."""

    near: float
    far: float


def bin_scale(bins: Sequence[BinSizes], cameras: Iterable[Mapping[str, Any]]) -> DepthScale | None:
    """Depths from the nearest corner of the bins' rims to the farthest of their floors, over some cameras; None: a camera has no pose.

    Args:
        bins: The bins.
        cameras: Records of scene_camera.json; their world is the bin's frame: origin in the middle of the inner floor, z up.
    """
    corners, depths = np.array([corner for sizes in bins for corner in sizes.inner_corners]), []
    for camera in cameras:
        if "cam_R_w2c" not in camera or "cam_t_w2c" not in camera:
            return None
        axis, offset = np.array(camera["cam_R_w2c"][6:9], float), float(camera["cam_t_w2c"][2])
        depths.append(corners @ axis * MM + offset)
    if not depths:
        return None
    near, far = float(np.min(depths)), float(np.max(depths))
    return DepthScale(near, far) if 0.0 < near < far else None


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
