"""Layers as files: how their numbers are kept in PNG images, and how to get them back.

    flow = read_layer(Path("DATA/train_pbr/000003"), "flow", 17)      # (H, W, 2) float32 [px], NaN: unknown

Axes are the camera's: x right, y down, z forward.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.errors import DatasetError

_ZERO = 32768
"""Code of 0 in a signed layer; codes are 16 bits."""
_LAST = 65535
_NORMAL_STEPS = 32767
"""Steps from 0 to 1 of a normal's component."""
_FLOW_STEPS = 64
"""Steps of a pixel, as in KITTI's flow images; they reach 512 px."""
_SCENE_FLOW_STEP = 2e-5
"""One step of scene flow [m]; 16 bits reach 0.655 m, in a tick of 1/15 s a speed of 9.8 m/s."""


@dataclass(frozen=True)
class _Layer:
    encode: Callable[[np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]
    channels: tuple[int, ...]
    """Of the image."""
    dtype: str
    """Of the image."""
    meaning: str
    """For the notes of a data set."""


def encode_layer(name: str, values: np.ndarray) -> np.ndarray:
    """The image of a layer: what `FrameBatch.layers` has of one view, as integers (H, W[, 3])."""
    return _LAYERS[name].encode(values)


def decode_layer(name: str, image: np.ndarray) -> np.ndarray:
    """Undo `encode_layer`, up to rounding.

    Returns:
        normals: (H, W, 3) float32, unit vectors; zero: no surface.
        albedo: (H, W, 3) uint8, sRGB, red first.
        nocs: (H, W, 3) float32 from 0 to 1; zero: no instance.
        classes: (H, W) uint16, obj_id; 0: no instance.
        flow: (H, W, 2) float32 [px], columns and rows; NaN: unknown.
        scene_flow: (H, W, 3) float32 [m]; NaN: unknown.
        depth_sensor: (H, W) uint16, counts of the depth scale; 0: hole.
    """
    return _LAYERS[name].decode(image)


def read_layer(scene: Path, name: str, frame: int) -> np.ndarray:
    """A layer of one image of a BOP scene, as `decode_layer` gives it.

    Raises:
        DatasetError: There is no such layer or file, or the file is no image of this layer.
    """
    if name not in _LAYERS:
        raise DatasetError(f"there is no layer {name}; layers: {', '.join(_LAYERS)}")
    layer = _LAYERS[name]
    path = layer_path(scene, name, frame)
    if not path.is_file():
        raise DatasetError(f"there is no {path}; bake with render.layers naming {name}")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.stat().st_size else None
    if image is None or image.dtype.name != layer.dtype or image.shape[2:] != layer.channels:
        raise DatasetError(f"{path} is no image of the layer {name}; bake the data set again")
    return layer.decode(image[..., ::-1] if layer.channels else image)


def layer_path(scene: Path, name: str, frame: int) -> Path:
    """Where an image's layer lies."""
    return scene / name / f"{frame:06d}.png"


def layer_notes(names: tuple[str, ...]) -> str:
    """What a user of these layers must know, one line each, as Markdown."""
    return "".join(f"- `{name}/`: {layer.meaning}\n" for name, layer in _LAYERS.items() if name in names)


def _same(values: np.ndarray) -> np.ndarray:
    return values


def _some(image: np.ndarray) -> np.ndarray:
    """Pixels of which a channel is not 0 (H, W, 1) bool; much faster than NumPy's `any` over so few."""
    return (image[..., 0:1] != 0) | (image[..., 1:2] != 0) | (image[..., 2:3] != 0)


def _coded(values: np.ndarray, scale: float, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Codes of signed numbers (H, W, C) uint16, 0 in pixels that have a number without code, and which have none such (H, W, 1) bool."""
    # float32 holds codes of 16 bits to 1/256 of a step.
    code = np.rint(np.float32(scale) * values + np.float32(_ZERO))
    # Comparisons with NaN are False.
    fits = (code >= least) & (code <= _LAST)
    valid = functools.reduce(np.logical_and, (fits[..., channel : channel + 1] for channel in range(fits.shape[-1])))
    code[~valid[..., 0]] = 0.0
    return code.astype(np.uint16), valid


def _encode_normals(values: np.ndarray) -> np.ndarray:
    return _coded(values, _NORMAL_STEPS, 1)[0] * _some(values)


def _decode_normals(image: np.ndarray) -> np.ndarray:
    values = (image.astype(np.float32) - _ZERO) / _NORMAL_STEPS
    return np.where(_some(image), values, np.float32(0.0))


def _encode_nocs(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(_LAST * values, 0, _LAST)).astype(np.uint16)


def _decode_nocs(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float32) / _LAST


def _encode_flow(values: np.ndarray) -> np.ndarray:
    return np.concatenate(_coded(values, _FLOW_STEPS, 0), axis=-1, dtype=np.uint16)


def _decode_flow(image: np.ndarray) -> np.ndarray:
    values = (image[..., :2].astype(np.float32) - _ZERO) / _FLOW_STEPS
    return np.where(image[..., 2:] > 0, values, np.float32(np.nan))


def _encode_scene_flow(values: np.ndarray) -> np.ndarray:
    return _coded(values, 1.0 / _SCENE_FLOW_STEP, 1)[0]


def _decode_scene_flow(image: np.ndarray) -> np.ndarray:
    values = np.float32(_SCENE_FLOW_STEP) * (image.astype(np.float32) - _ZERO)
    return np.where(_some(image), values, np.float32(np.nan))


_LAYERS = {
    "normals": _Layer(
        _encode_normals,
        _decode_normals,
        (3,),
        "uint16",
        f"unit normals towards the camera, in its axes; red, green and blue are {_ZERO} + {_NORMAL_STEPS} times x, y and z; 0, 0, 0: no "
        "surface. They are interpolated between vertices, as those of the picture.",
    ),
    "albedo": _Layer(_same, _same, (3,), "uint8", "base colour without light, sRGB; black where no surface is."),
    "nocs": _Layer(
        _encode_nocs,
        _decode_nocs,
        (3,),
        "uint16",
        f"where on its object the pixel lies: {_LAST} times ((p - c) / d + 0.5), with p in the model's axes, c = min + size / 2 and "
        "d = |size| from models_info.json; so p = c + d (value - 0.5). 0, 0, 0: no instance.",
    ),
    "classes": _Layer(_same, _same, (), "uint16", "obj_id; 0: no instance."),
    "flow": _Layer(
        _encode_flow,
        _decode_flow,
        (3,),
        "uint16",
        "optical flow to the image before this one, in KITTI's format: the pixel's surface point was then (red - "
        f"{_ZERO}) / {_FLOW_STEPS} columns to the right and (green - {_ZERO}) / {_FLOW_STEPS} rows down, hidden or not. Blue 0: unknown: "
        f"no surface, the scene's first image, what was not in the scene then, or {_ZERO // _FLOW_STEPS} pixels and more.",
    ),
    "scene_flow": _Layer(
        _encode_scene_flow,
        _decode_scene_flow,
        (3,),
        "uint16",
        f"the same as displacement in the camera's axes: red, green and blue minus {_ZERO}, times {1e3 * _SCENE_FLOW_STEP:g} mm; 0, 0, 0: "
        f"unknown, or {_ZERO * _SCENE_FLOW_STEP:.3f} m and more.",
    ),
    "depth_sensor": _Layer(
        _same,
        _same,
        (),
        "uint16",
        "what a depth camera might measure (`depth_sensor` in config.toml): noise, steps and holes, which are 0; counts as in `depth/`.",
    ),
}
"""Keys are `configs.schema.LAYERS`, in that order."""
