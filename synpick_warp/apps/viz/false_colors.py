"""False-colour images of depth, on one scale for all pictures that stand beside each other, and of layers (AOVs)."""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import GOLDEN, Image
from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.dataset.view import read_layer
from synpick_warp.dataset.view_files import SceneFiles

_RANGE = (1.0, 99.0)
"""Depth percentiles at the ends of the colour map, if no bin defines its range."""
_EVERY = 7
"""Every n-th pixel counts for percentiles."""
MM = 1000.0
"""Millimetres in a metre."""
_MOTION_RANGE = 99.0
"""Percentile of an image's motions that maps to full colour."""
_GREY = 64
"""Grey level of unknown pixels, which differ from static ones."""


class DepthScale(NamedTuple):
    """Colour scale of depth: the depths of the first (near) and the last colour (far) [mm]."""

    near: float
    far: float


def bin_scale(bins: Sequence[BinSizes], cameras: Iterable[Mapping[str, Any]]) -> DepthScale | None:
    """Depths from the nearest corner of the bins' rims to the farthest of their floors, over some cameras; None: a camera has no pose.

    The world of the cameras' records is the bin's frame: origin in the middle of the inner floor, z up.
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


def draw_layer(name: str, values: np.ndarray, depth_scale: DepthScale | None = None) -> tuple[str, Image]:
    """Caption and colours of one layer, from its values as `synpick_warp.dataset.view.read_layer` returns them.

    `depth_scale` is that of depth images beside it, in the unit of the values; None: the image's own.
    """
    if name not in _DEPTHS:
        return _DRAW[name](values)
    return f"{_DEPTHS[name]}: {100.0 * (values == 0).mean():.1f} % holes, black", color_depth(values, depth_scale)


def layer_pictures(files: SceneFiles, frame: int, depth_scale: DepthScale | None) -> list[tuple[str, Image]]:
    """Caption and colours of each layer that a scene has; raises DatasetError if the scene has a layer, but not for this frame, or the file
    is damaged."""
    present = [name for name in (*_DRAW, *_DEPTHS) if files.has(name)]
    return [draw_layer(name, read_layer(files, name, frame), depth_scale) for name in present]


def _draw_normals(values: np.ndarray) -> tuple[str, Image]:
    """Normal map in OpenGL's convention: red right, green up, blue towards the camera."""
    colors = (values * np.array([1.0, -1.0, -1.0], np.float32) + 1.0) / 2.0
    colors[~values.any(axis=-1)] = 0.0
    return "normals: red right, green up, blue to the camera", _bytes(colors)


def _draw_classes(values: np.ndarray) -> tuple[str, Image]:
    """Caption and picture of class ids, a hue each; 0, nothing, is black."""
    present = np.unique(values[values > 0])
    hue = (values * GOLDEN) % 1.0
    return f"classes: {len(present)} present", _from_hsv(hue, np.where(values > 0, 1.0, 0.0))


def _draw_flow(values: np.ndarray) -> tuple[str, Image]:
    """Caption and picture of optical flow: hue is direction, saturation length; unknown (NaN) is grey."""
    size = np.hypot(values[..., 0], values[..., 1])
    full = _full_scale(size)
    colors = _from_hsv(np.arctan2(values[..., 1], values[..., 0]) / (2 * np.pi) % 1.0, size / full)
    return f"flow to the image before: up to {full:.1f} px; grey: unknown", _with_unknown(colors, size)


def _draw_scene_flow(values: np.ndarray) -> tuple[str, Image]:
    """Caption and picture of scene flow: x, y, z as red, green, blue around grey; unknown is marked."""
    size = np.linalg.norm(values, axis=-1)
    full = _full_scale(size)
    colors = _bytes((values / full + 1.0) / 2.0)
    return f"scene flow: x, y, z as red, green, blue, up to {1e3 * full:.1f} mm", _with_unknown(colors, size)


def _draw_score(caption: str, values: np.ndarray) -> tuple[str, Image]:
    """Scores 0 to 1 as a VIRIDIS colour map; 0 is black."""
    colors = cv2.applyColorMap(np.rint(255.0 * values).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return caption, np.where((values > 0.0)[..., None], colors, np.uint8(0))


def _full_scale(size: np.ndarray) -> float:
    """Motion that maps to full colour; 1 if nothing moves."""
    known = size[np.isfinite(size) & (size > 0.0)]
    return float(np.percentile(known, _MOTION_RANGE)) if known.size else 1.0


def _with_unknown(colors: Image, size: np.ndarray) -> Image:
    """Replace pixels of unknown motion (NaN) by grey."""
    return np.where(np.isfinite(size)[..., None], colors, np.uint8(_GREY))


def _bytes(colors: np.ndarray) -> Image:
    """Convert red, green, blue from 0 to 1 to bytes, blue first."""
    return np.rint(255.0 * np.clip(np.nan_to_num(colors[..., ::-1]), 0.0, 1.0)).astype(np.uint8)


def _from_hsv(hue: np.ndarray, value: np.ndarray) -> Image:
    """Saturated colours of a hue and a value from 0 to 1."""
    planes = (360.0 * np.nan_to_num(hue), np.ones_like(value), np.clip(np.nan_to_num(value), 0.0, 1.0))
    return _bytes(cv2.cvtColor(np.stack(planes, axis=-1).astype(np.float32), cv2.COLOR_HSV2RGB))


_DRAW: dict[str, Callable[[np.ndarray], tuple[str, Image]]] = {
    "normals": _draw_normals,
    "albedo": lambda values: ("albedo", np.ascontiguousarray(values[..., ::-1])),
    "nocs": lambda values: ("nocs: red x, green y, blue z of the object", _bytes(values)),
    "classes": _draw_classes,
    "flow": _draw_flow,
    "scene_flow": _draw_scene_flow,
    "ir_left": lambda values: ("infrared, left", np.repeat(values[..., None], 3, axis=-1)),
    "ir_right": lambda values: ("infrared, right", np.repeat(values[..., None], 3, axis=-1)),
    "suction_seal": functools.partial(_draw_score, "suction: seal, yellow 1, blue near 0, black 0"),
    "suction_wrench": functools.partial(_draw_score, "suction: wrench, yellow 1, blue near 0, black 0"),
}
_DEPTHS = {"depth_sensor": "depth sensor", "depth_stereo": "stereo depth"}
"""Layers of depth, and their captions."""
