"""Image decoding for validation: PNG, JPEG and TIFF, with the bit depth and colour type that the file states; masks as crops."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import cv2
import numpy as np

from synpick_warp.errors import DatasetError
from synpick_warp.inputs.image_files import MAX_SIDE, decode_image

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
"""Byte order of a TIFF file by its signature (TIFF 6.0, section 2)."""
_WIDTH, _HEIGHT = 256, 257
"""Tags ImageWidth and ImageLength."""
_TYPES = {3: "H", 4: "I"}
"""Field types SHORT and LONG."""
_COLOUR_TYPES = {0: "greyscale", 2: "RGB", 3: "palette", 4: "greyscale with alpha", 6: "RGB with alpha"}
"""PNG specification, table 11.1."""


def tiff_size(data: bytes) -> tuple[int, int] | None:
    """Width and height [px] that the first image of a TIFF file states; None: it is no TIFF file, or damaged."""
    order = _TIFF.get(data[:4])
    if order is None or len(data) < 8:
        return None
    start = struct.unpack_from(f"{order}I", data, 4)[0]
    if start + 2 > len(data):
        return None
    found: dict[int, int] = {}
    for index in range(struct.unpack_from(f"{order}H", data, start)[0]):
        place = start + 2 + 12 * index
        if place + 12 > len(data):
            return None
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, place)
        if tag in (_WIDTH, _HEIGHT) and kind in _TYPES and count == 1:
            found[tag] = struct.unpack_from(f"{order}{_TYPES[kind]}", data, place + 8)[0]
    return (found[_WIDTH], found[_HEIGHT]) if len(found) == 2 else None


def decode_picture(data: bytes, source: str) -> np.ndarray:
    """Decode a PNG, JPEG or TIFF file without conversion (H, W[, C]), blue first.

    Raises:
        DatasetError: It is not such an image, or larger than MAX_SIDE.
    """
    if data[:4] not in _TIFF:
        return decode_image(data, source, DatasetError)
    size = tiff_size(data)
    if size is None or not (min(size) > 0 and max(size) <= MAX_SIDE):
        raise DatasetError(f"{source} is not a TIFF image of up to {MAX_SIDE} x {MAX_SIDE} pixels")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[1::-1] != size:
        raise DatasetError(f"{source} is not an image that OpenCV can decode")
    return image


def png_type(data: bytes) -> tuple[int, str] | None:
    """Bit depth and colour type of a PNG file; None: it is no PNG file."""
    if not data.startswith(_PNG) or len(data) < 26:
        return None
    return data[24], _COLOUR_TYPES.get(data[25], f"of colour type {data[25]}")


@dataclass(frozen=True, eq=False)
class Mask:
    """A mask as the crop that contains all of its pixels."""

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
        """Number of pixels."""
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
    image = decode_picture(data, file)
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
