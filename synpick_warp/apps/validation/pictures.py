"""Masks for validation, as crops, with the bit depth and colour type that the file states."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.image_files import decode_picture

_PNG = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {0: "greyscale", 2: "RGB", 3: "palette", 4: "greyscale with alpha", 6: "RGB with alpha"}
"""PNG specification, table 11.1."""


def png_type(data: bytes) -> tuple[int, str] | None:
    """Bit depth and colour type of a PNG file; None: it is no PNG file."""
    if not data.startswith(_PNG) or len(data) < 26:
        return None
    return data[24], _COLOUR_TYPES.get(data[25], f"of colour type {data[25]}")


@dataclass(frozen=True, eq=False)
class Mask:
    """Mask of an instance as the crop (at left, top) that contains all of its pixels, with the image size, and how the file was encoded."""

    file: str
    size: tuple[int, int]
    """Width and height of the image [px]."""
    left: int
    top: int
    crop: np.ndarray
    """(h, w) bool; (0, 0): the mask is empty."""
    binary: bool = True
    """Whether the image has no values besides 0 and 255."""
    kind: tuple[int, str] | None = (8, "greyscale")
    """Bit depth and colour type of the file; None: no PNG."""

    @property
    def count(self) -> int:
        """Number of pixels that are set."""
        return int(np.count_nonzero(self.crop))

    @property
    def box(self) -> tuple[int, int, int, int] | None:
        """Column, row, width and height [px] of the tight box; None: the mask is empty."""
        height, width = self.crop.shape
        return (self.left, self.top, width, height) if self.crop.size else None

    def window(self, left: int, top: int, width: int, height: int) -> np.ndarray:
        """Crop of the mask's image (height, width) bool at another place; outside of the image it is False."""
        result = np.zeros((height, width), bool)
        rows, columns = self.crop.shape
        first, last = max(left, self.left), min(left + width, self.left + columns)
        upper, lower = max(top, self.top), min(top + height, self.top + rows)
        if first < last and upper < lower:
            part = self.crop[upper - self.top : lower - self.top, first - self.left : last - self.left]
            result[upper - top : lower - top, first - left : last - left] = part
        return result


def decode_mask(data: bytes, file: str) -> Mask:
    """Decode a mask; raises as `decode_picture`."""
    image = decode_picture(data, file, DatasetError)
    size, kind = (image.shape[1], image.shape[0]), png_type(data)
    if image.ndim != 2 or image.dtype != np.uint8:
        flat = np.asarray(image.reshape(*image.shape[:2], -1).any(axis=2))
        return crop_mask(flat, file, binary=False, kind=kind or (8 * image.itemsize, f"of {image.shape[2:] or 1} channels"))
    left, top, width, height = cv2.boundingRect(image)
    crop = image[top : top + height, left : left + width]
    filled = crop > 0
    binary = int(crop.sum(dtype=np.int64)) == 255 * int(np.count_nonzero(filled))
    return Mask(file, size, left, top, filled, binary, kind)


def crop_mask(image: np.ndarray, file: str, *, binary: bool = True, kind: tuple[int, str] | None = (8, "greyscale")) -> Mask:
    """Mask from a whole image (H, W) bool."""
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(image).view(np.uint8))
    crop = np.ascontiguousarray(image[top : top + height, left : left + width])
    return Mask(file, (image.shape[1], image.shape[0]), left, top, crop, binary, kind)
