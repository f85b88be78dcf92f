"""Pictures of layers, for people: directions, places and motions as colours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.layer_codec import read_layer

_MOTION_RANGE = 99.0
"""Percentile of a picture's motions that gets full colour."""
_DEPTH_RANGE = (1.0, 99.0)
"""Percentiles of a picture's depths that get the first and the last colour."""
_GOLDEN = 0.6180339887498949
"""(√5 - 1) / 2: its multiples modulo 1 are evenly spread, however many are taken."""
_GREY = 64
"""Of what is unknown, so that it differs from what stands still."""

Image = np.ndarray
"""(H, W, 3) uint8, blue first."""


def layer_pictures(scene: Path, frame: int) -> list[tuple[str, Image]]:
    """Caption and picture of each layer that a scene has and `_DRAW` can draw.

    Raises:
        DatasetError: The scene has a layer, but not of this image.
    """
    return [draw(read_layer(scene, name, frame)) for name, draw in _DRAW.items() if (scene / name).is_dir()]


def _draw_normals(values: np.ndarray) -> tuple[str, Image]:
    """As OpenGL's normal maps: red right, green up, blue towards the camera."""
    colors = (values * np.array([1.0, -1.0, -1.0], np.float32) + 1.0) / 2.0
    colors[~values.any(axis=-1)] = 0.0
    return "normals: red right, green up, blue to the camera", _bytes(colors)


def _draw_albedo(values: np.ndarray) -> tuple[str, Image]:
    return "albedo", np.ascontiguousarray(values[..., ::-1])


def _draw_nocs(values: np.ndarray) -> tuple[str, Image]:
    return "nocs: red x, green y, blue z of the object", _bytes(values)


def _draw_classes(values: np.ndarray) -> tuple[str, Image]:
    present = np.unique(values[values > 0])
    hue = (values * _GOLDEN) % 1.0
    return f"classes: {len(present)} kinds", _from_hsv(hue, np.where(values > 0, 1.0, 0.0))


def _draw_flow(values: np.ndarray) -> tuple[str, Image]:
    size = np.hypot(values[..., 0], values[..., 1])
    full = _full(size)
    colors = _from_hsv(np.arctan2(values[..., 1], values[..., 0]) / (2 * np.pi) % 1.0, size / full)
    return f"flow to the image before: up to {full:.1f} px; grey: unknown", _with_unknown(colors, size)


def _draw_scene_flow(values: np.ndarray) -> tuple[str, Image]:
    size = np.linalg.norm(values, axis=-1)
    full = _full(size)
    colors = _bytes((values / full + 1.0) / 2.0)
    return f"scene flow: x, y, z as red, green, blue, up to {1e3 * full:.1f} mm", _with_unknown(colors, size)


def _draw_depth_sensor(values: np.ndarray) -> tuple[str, Image]:
    """As the picture of depth; holes are black."""
    known = values[values > 0]
    low, high = np.percentile(known, _DEPTH_RANGE) if known.size else (0.0, 1.0)
    nearness = np.clip((high - values) / max(high - low, 1e-9), 0.0, 1.0)
    colors = cv2.applyColorMap(np.rint(255.0 * nearness).astype(np.uint8), cv2.COLORMAP_TURBO)
    holes = values == 0
    colors[holes] = 0
    return f"depth sensor: {100.0 * holes.mean():.1f} % holes, black", colors


def _full(size: np.ndarray) -> float:
    """The motion that gets full colour; 1 where nothing is known to move."""
    known = size[np.isfinite(size) & (size > 0.0)]
    return float(np.percentile(known, _MOTION_RANGE)) if known.size else 1.0


def _with_unknown(colors: Image, size: np.ndarray) -> Image:
    return np.where(np.isfinite(size)[..., None], colors, np.uint8(_GREY))


def _bytes(colors: np.ndarray) -> Image:
    """From red, green, blue in 0 to 1."""
    return np.rint(255.0 * np.clip(np.nan_to_num(colors[..., ::-1]), 0.0, 1.0)).astype(np.uint8)


def _from_hsv(hue: np.ndarray, value: np.ndarray) -> Image:
    """Full colours of hue 0 to 1 and brightness 0 to 1."""
    planes = (360.0 * np.nan_to_num(hue), np.ones_like(value), np.clip(np.nan_to_num(value), 0.0, 1.0))
    return _bytes(cv2.cvtColor(np.stack(planes, axis=-1).astype(np.float32), cv2.COLOR_HSV2RGB))


_DRAW: dict[str, Callable[[np.ndarray], tuple[str, Image]]] = {
    "normals": _draw_normals,
    "albedo": _draw_albedo,
    "nocs": _draw_nocs,
    "classes": _draw_classes,
    "flow": _draw_flow,
    "scene_flow": _draw_scene_flow,
    "depth_sensor": _draw_depth_sensor,
}
