"""PNG codec of annotation layers: quantizes their values to 8 or 16 bits, and back.

The layers, with type, unit and meaning of their values: `layers.LAYER_TABLE`. Axes are the camera's: x right, y down, z forward.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from synpick_warp.views.layers import FLOW_STEPS, LAYER_TABLE, MAX_CODE, NORMAL_STEPS, SCENE_FLOW_STEP, ZERO_CODE


class Codec(NamedTuple):
    """Codec of a layer: encoding of values as pixels of an image, and its inverse."""

    encode: Callable[[np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]


def encode_layer(name: str, values: np.ndarray) -> np.ndarray:
    """Quantize one view's layer: values (H, W[, C]) as in `FrameBatch.layers` to an image of integers (H, W[, 3])."""
    return CODECS[LAYER_TABLE[name].encoding].encode(values)


def decode_layer(name: str, image: np.ndarray) -> np.ndarray:
    """Undo `encode_layer`, up to rounding. Returns values of the type, components, unit and meaning that `LAYER_TABLE` states: normals,
    nocs and scene_flow (H, W, 3) float32, flow (H, W, 2) float32, suction_seal and suction_wrench (H, W) float32, albedo (H, W, 3) uint8,
    classes, depth_sensor and depth_stereo (H, W) uint16, ir_left and ir_right (H, W) uint8."""
    return CODECS[LAYER_TABLE[name].encoding].decode(image)


def layer_path(scene: Path, name: str, frame: int) -> Path:
    """File of an image's layer, in the folder of a BOP scene."""
    return scene / name / f"{frame:06d}.png"


def layer_notes(names: tuple[str, ...]) -> str:
    """Markdown for a data set's notes: one line per layer, with the meaning of its file's codes."""
    return "".join(f"- `{name}/`: {LAYER_TABLE[name].note}\n" for name in LAYER_TABLE if name in names)


def image_format(name: str) -> tuple[str, int | None]:
    """Type and channels (None: two dimensions) of a layer's image: raw layers keep theirs, all others have 16 bits and, but for layers of
    one component, three channels."""
    layer = LAYER_TABLE[name]
    if layer.encoding != "raw":
        return "uint16", 3 if layer.components > 1 else None
    return layer.dtype, layer.components if layer.components > 1 else None


def _keep(values: np.ndarray) -> np.ndarray:
    """Values as they are: a layer that is stored without encoding."""
    return values


def _any_channel(image: np.ndarray) -> np.ndarray:
    """True where a channel is not 0 (H, W, 1) bool; much faster than NumPy's `any` over an axis of three."""
    return (image[..., 0:1] != 0) | (image[..., 1:2] != 0) | (image[..., 2:3] != 0)


def _quantize_signed(values: np.ndarray, scale: float, min_code: int) -> tuple[np.ndarray, np.ndarray]:
    """Codes rint(scale · value) + ZERO_CODE of signed values (H, W, C). Returns the codes (H, W, C) uint16, 0 in pixels with a component
    that is NaN or out of range, and the mask of the other pixels (H, W, 1) bool."""
    # float32 holds codes of 16 bits to 1/256 of a step.
    code = np.rint(np.float32(scale) * values + np.float32(ZERO_CODE))
    # Comparisons with NaN are False.
    fits = (code >= min_code) & (code <= MAX_CODE)
    valid = functools.reduce(np.logical_and, (fits[..., channel : channel + 1] for channel in range(fits.shape[-1])))
    code[~valid[..., 0]] = 0.0
    return code.astype(np.uint16), valid


def _encode_unit_vector(values: np.ndarray) -> np.ndarray:
    """Encode unit vectors as signed codes around ZERO_CODE; zero vectors, nothing there, become 0."""
    return _quantize_signed(values, NORMAL_STEPS, 1)[0] * _any_channel(values)


def _decode_unit_vector(image: np.ndarray) -> np.ndarray:
    """Inverse of `_encode_unit_vector`, as float32."""
    values = (image.astype(np.float32) - ZERO_CODE) / NORMAL_STEPS
    return np.where(_any_channel(image), values, np.float32(0.0))


def _encode_fraction(values: np.ndarray) -> np.ndarray:
    """Encode fractions 0 to 1, clipped, as 16-bit codes."""
    return np.rint(np.clip(MAX_CODE * values, 0, MAX_CODE)).astype(np.uint16)


def _decode_fraction(image: np.ndarray) -> np.ndarray:
    """Inverse of `_encode_fraction`, as float32."""
    return image.astype(np.float32) / MAX_CODE


def _encode_flow(values: np.ndarray) -> np.ndarray:
    """Encode flow [px] as two 16-bit channels, and a third that is above 0 where it is known."""
    return np.concatenate(_quantize_signed(values, FLOW_STEPS, 0), axis=-1, dtype=np.uint16)


def _decode_flow(image: np.ndarray) -> np.ndarray:
    """Inverse of `_encode_flow`, as float32; NaN: unknown."""
    values = (image[..., :2].astype(np.float32) - ZERO_CODE) / FLOW_STEPS
    return np.where(image[..., 2:] > 0, values, np.float32(np.nan))


def _encode_displacement(values: np.ndarray) -> np.ndarray:
    """Encode displacements in steps of SCENE_FLOW_STEP; all channels 0: unknown."""
    return _quantize_signed(values, 1.0 / SCENE_FLOW_STEP, 1)[0]


def _decode_displacement(image: np.ndarray) -> np.ndarray:
    """Inverse of `_encode_displacement`, as float32; NaN: unknown."""
    values = np.float32(SCENE_FLOW_STEP) * (image.astype(np.float32) - ZERO_CODE)
    return np.where(_any_channel(image), values, np.float32(np.nan))


CODECS = {
    "raw": Codec(_keep, _keep),
    "unit_vector": Codec(_encode_unit_vector, _decode_unit_vector),
    "fraction": Codec(_encode_fraction, _decode_fraction),
    "flow": Codec(_encode_flow, _decode_flow),
    "displacement": Codec(_encode_displacement, _decode_displacement),
}
"""raw: integers as they are. unit_vector: signed, code 0 for the zero vector. fraction: 0 to 1. flow: as KITTI's, the third channel is 1
where the flow is known. displacement: signed, code 0 for unknown."""
