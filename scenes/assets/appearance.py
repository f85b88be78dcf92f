"""Colour conversion and textures: sRGB transfer function, 8-bit conversion, vertex colour baking, texture atlases."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.asset_files import describe_error, quiet_decoding

MAX_TEXTURE_FILE = 2**27
"""Largest image file [bytes]: 128 MiB."""
MAX_TEXTURE_PIXELS = 2**26
"""Maximum number of pixels of a texture, and of all textures of one model: 8192², which take 0.7 GB while they are decoded."""
TEXTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA", "GIF", "PPM", "JPEG2000", "DDS")
"""Formats that Pillow may decode: rasters only; for others, such as EPS, it starts other programs."""

# Linear segment of the sRGB transfer function (IEC 61966-2-1).
_SRGB_TOE = 0.04045
_LINEAR_TOE = 0.0031308


@dataclass(frozen=True, eq=False)
class FileMaterial:
    """Material properties that a mesh file contains; None for those that it does not."""

    color: tuple[float, float, float]
    """Base colour factor, sRGB in 0..1; multiplies the texture in linear light."""
    texture: np.ndarray | None
    """Base colour texture (H, W, 3) uint8, sRGB, top row first (v = 1)."""
    metallic: float | None
    roughness: float | None


def srgb_to_linear(value: Any) -> np.ndarray:
    """Decode sRGB in 0..1 to linear light in 0..1, any shape."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= _SRGB_TOE, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Any) -> np.ndarray:
    """Encode linear light, clipped to 0..1, as sRGB in 0..1, any shape."""
    value = np.clip(np.asarray(value, dtype=np.float64), 0.0, 1.0)
    return np.where(value <= _LINEAR_TOE, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


def as_color(channels: np.ndarray) -> tuple[float, float, float]:
    """Convert a colour (3) to a tuple."""
    return float(channels[0]), float(channels[1]), float(channels[2])


def rgb8(image: Image.Image) -> np.ndarray:
    """Convert an image of any mode to 8-bit RGB (H, W, 3).

    Grey becomes three equal channels; palettes and CMYK are converted. 16-bit grey is rounded to 8 bits, 16-bit colour is truncated.
    Alpha is dropped: objects are opaque, and texture bakers pad transparent texels with colour for filtering.
    """
    if image.mode == "F":
        grey = np.clip(np.nan_to_num(np.asarray(image)), 0.0, 1.0) * 255.0
    elif image.mode.startswith("I"):
        grey = np.asarray(image).astype(np.float64).clip(0, 65535) / 257.0
    else:
        return np.ascontiguousarray(np.asarray(image.convert("RGB"), dtype=np.uint8))
    return np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)


def decode_texture(data: bytes, source: str) -> np.ndarray:
    """Decode an image as (H, W, 3) uint8. Its size is taken from the header and checked before any pixel is decoded.

    Args:
        data: The image file.
        source: Where it comes from, for errors.

    Raises:
        CatalogError: The image is too large, of another format, or damaged.
    """
    limit = f"allowed: {MAX_TEXTURE_PIXELS} pixels, such as 8192 x 8192; scale it down"
    with quiet_decoding():
        try:
            with Image.open(io.BytesIO(data), formats=TEXTURE_FORMATS) as image:
                if image.width * image.height <= MAX_TEXTURE_PIXELS:
                    return rgb8(image)
                size = f"{image.width} x {image.height}"
        except Image.DecompressionBombError:
            raise CatalogError(f"{source}: too large an image; {limit}") from None
        except UnidentifiedImageError:
            raise CatalogError(f"{source}: not readable as an image (its format is unknown); use PNG or JPEG") from None
        except Exception as error:  # Pillow's decoders raise nearly anything on damaged files
            raise CatalogError(f"{source}: not readable as an image ({describe_error(error)}); use PNG or JPEG") from None
    raise CatalogError(f"{source}: too large an image, {size} pixels; {limit}")


def bake_vertex_colors(faces: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bake vertex colours into a texture atlas with 2 x 2 texels for each triangle.

    With corner colours a, b, c, three texels hold these and the fourth b + c - a, clipped to 0 .. 1: where nothing is clipped, bilinear
    filtering equals barycentric interpolation over the triangle up to 8-bit rounding. It never reads another triangle's texels.

    Args:
        faces: Vertex indices (F, 3).
        colors: Vertex colours, sRGB (V, 3) uint8.

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


def join_textures(parts: list[tuple[np.ndarray | None, FileMaterial]], owner: str) -> tuple[list[np.ndarray], np.ndarray]:
    """Merge the materials of several parts into one texture atlas, with base colour factors multiplied in.

    Args:
        parts: Texture coordinates (V, 2) or None, and the material, of each part.
        owner: The mesh file, for errors.

    Returns:
        New texture coordinates of each part, one row (1, 2) for parts without a texture; and the atlas (H, W, 3) uint8.

    Raises:
        CatalogError: A texture repeats, which an atlas does not allow, or the atlas is too large.
    """
    blocks, uvs = [], []
    for uv, material in parts:
        if material.texture is None or uv is None:
            texture, uv = np.full((4, 4, 3), 255, np.uint8), np.full((1, 2), 0.5)
        else:
            texture = material.texture
        # A table of the 256 levels, since whole images in 64-bit floats take eight times the room.
        levels = srgb_to_linear(np.arange(256) / 255.0)[:, None] * srgb_to_linear(material.color)
        table = np.rint(linear_to_srgb(levels) * 255.0).astype(np.uint8)
        blocks.append(np.stack([table[texture[..., channel], channel] for channel in range(3)], axis=-1))
        uvs.append(uv)
    width, height = max(block.shape[1] for block in blocks), sum(block.shape[0] for block in blocks)
    if width * height > MAX_TEXTURE_PIXELS:
        raise CatalogError(f"{owner}: its textures together take {width} x {height} pixels; allowed: {MAX_TEXTURE_PIXELS}; scale them down")
    atlas, top, new_uvs = np.zeros((height, width, 3), np.uint8), 0, []
    for block, uv in zip(blocks, uvs, strict=True):
        if uv.min() < -1e-3 or uv.max() > 1.0 + 1e-3:
            raise CatalogError(f"{owner}: several materials, and a texture that repeats (coordinates beyond 0..1); bake one image")
        rows, columns = block.shape[:2]
        atlas[top : top + rows, :columns] = block
        # At least half a texel from the block's border, so that filtering does not bleed.
        column = np.clip(uv[:, 0] * columns, 0.5, columns - 0.5)
        row = top + np.clip((1.0 - uv[:, 1]) * rows, 0.5, rows - 0.5)
        new_uvs.append(np.stack([column / width, 1.0 - row / height], axis=1))
        top += rows
    return new_uvs, atlas
