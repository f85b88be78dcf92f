"""Base colour and texture in the one form that the renderer takes: 8-bit sRGB."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from synpick_warp.errors import CatalogError

# IEC 61966-2-1, the transfer function of sRGB.
_SRGB_TOE = 0.04045
_LINEAR_TOE = 0.0031308


@dataclass(frozen=True, eq=False)
class Finish:
    """What a mesh file says about its surface; None where it is silent."""

    color: tuple[float, float, float]
    """Base colour, sRGB; multiplies the texture in linear light."""
    texture: np.ndarray | None
    """(H, W, 3) uint8, sRGB, row 0 at v = 1."""
    metallic: float | None
    roughness: float | None


def srgb_to_linear(value: Any) -> np.ndarray:
    """sRGB in 0..1 to linear light in 0..1, any shape."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= _SRGB_TOE, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Any) -> np.ndarray:
    """Linear light, clipped to 0..1, to sRGB in 0..1, any shape."""
    value = np.clip(np.asarray(value, dtype=np.float64), 0.0, 1.0)
    return np.where(value <= _LINEAR_TOE, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


def as_color(channels: np.ndarray) -> tuple[float, float, float]:
    """Three channels (3) in the form that materials have."""
    return float(channels[0]), float(channels[1]), float(channels[2])


def rgb8(image: Image.Image) -> np.ndarray:
    """Any kind of picture as (H, W, 3) uint8.

    Grey becomes three equal channels, palettes and CMYK are resolved. Grey of 16 bits is rounded to 8, of colours of 16 bits the upper 8
    are kept. Alpha is dropped: objects are opaque, and the colour under transparent texels is the padding that texture bakers leave for
    filtering.
    """
    if image.mode == "F":
        grey = np.clip(np.asarray(image), 0.0, 1.0) * 255.0
    elif image.mode.startswith("I"):
        grey = np.asarray(image).astype(np.float64).clip(0, 65535) / 257.0
    else:
        return np.ascontiguousarray(np.asarray(image.convert("RGB"), dtype=np.uint8))
    return np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)


def read_texture(path: Path, owner: str) -> np.ndarray:
    """Read a texture file as (H, W, 3) uint8.

    Args:
        path: The picture.
        owner: What names the texture, for the error's sentence.

    Raises:
        CatalogError: There is no such file, or it is no picture.
    """
    if not path.is_file():
        raise CatalogError(f"{owner} names the texture {path.name!r}, but there is no file {path}; put it there or remove the reference")
    try:
        with Image.open(path) as image:
            return rgb8(image)
    except Exception as error:  # Pillow's decoders raise nearly anything on damaged files
        raise CatalogError(f"{path}: not readable as a picture ({error}); use PNG or JPEG") from error


def bake_vertex_colors(faces: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn vertex colours into a texture with a 2 x 2 cell for each triangle.

    Three texel centres of a cell carry the triangle's colours, the fourth b + c - a: then bilinear filtering is linear
    interpolation over the triangle, and never reads another cell.

    Args:
        faces: (F, 3).
        colors: sRGB (V, 3) uint8.

    Returns:
        Texture coordinates of the 3 F corners (3 F, 2) float32, and the texture (S, S, 3) uint8.
    """
    cells = int(np.ceil(np.sqrt(len(faces))))
    side = 2 * cells
    row, column = (2 * index for index in np.divmod(np.arange(len(faces)), cells))
    corner = srgb_to_linear(colors[faces] / 255.0)
    texture = np.zeros((side, side, 3))
    texture[row, column], texture[row, column + 1], texture[row + 1, column] = corner[:, 0], corner[:, 1], corner[:, 2]
    texture[row + 1, column + 1] = corner[:, 1] + corner[:, 2] - corner[:, 0]
    rows = np.stack([row, row, row + 1], axis=1) + 0.5
    columns = np.stack([column, column + 1, column], axis=1) + 0.5
    uv = np.stack([columns / side, 1.0 - rows / side], axis=-1).reshape(-1, 2)
    return uv.astype(np.float32), np.rint(linear_to_srgb(texture) * 255.0).astype(np.uint8)


def join_textures(parts: list[tuple[np.ndarray | None, Finish]], owner: str) -> tuple[list[np.ndarray], np.ndarray]:
    """Stack the finishes of several parts into one texture, base colours multiplied in.

    Args:
        parts: Texture coordinates (V, 2) or None, and the finish, of each part.
        owner: The file, for the error's sentence.

    Returns:
        New texture coordinates of each part, one row (1, 2) for parts without a texture; and the texture (H, W, 3) uint8.

    Raises:
        CatalogError: A texture repeats; it cannot while it shares an image with others.
    """
    blocks, uvs = [], []
    for uv, finish in parts:
        if finish.texture is None or uv is None:
            texture, uv = np.full((4, 4, 3), 255, np.uint8), np.full((1, 2), 0.5)
        else:
            texture = finish.texture
        light = srgb_to_linear(texture / 255.0) * srgb_to_linear(finish.color)
        blocks.append(np.rint(linear_to_srgb(light) * 255.0).astype(np.uint8))
        uvs.append(uv)
    width, height = max(block.shape[1] for block in blocks), sum(block.shape[0] for block in blocks)
    atlas, top, moved = np.zeros((height, width, 3), np.uint8), 0, []
    for block, uv in zip(blocks, uvs, strict=True):
        if uv.min() < -1e-3 or uv.max() > 1.0 + 1e-3:
            raise CatalogError(f"{owner}: several materials, and a texture that repeats (coordinates beyond 0..1); bake one image")
        rows, columns = block.shape[:2]
        atlas[top : top + rows, :columns] = block
        # Kept half a texel from the block's border, so that filtering does not reach the neighbour.
        column = np.clip(uv[:, 0] * columns, 0.5, columns - 0.5)
        row = top + np.clip((1.0 - uv[:, 1]) * rows, 0.5, rows - 0.5)
        moved.append(np.stack([column / width, 1.0 - row / height], axis=1))
        top += rows
    return moved, atlas
