"""PNG decoder for a crop of a mask: inflates with ISA-L and undoes the "up" filter of the crop's columns only.

Several times as fast as decoding the whole image. Files with other filters, types or interlacing are left to OpenCV.
"""

from __future__ import annotations

import struct

import numpy as np
from isal import isal_zlib

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY_8 = (8, 0, 0, 0, 0)
"""Bit depth, colour type, compression, filter method and interlacing of 8-bit greyscale (PNG specification, section 11.2.2)."""
_NONE, _UP = 0, 2
"""Filter types of the PNG specification, section 9.2."""


def decode_grey_crop(data: bytes, size: tuple[int, int], rows: slice, columns: slice) -> np.ndarray | None:
    """Decode a crop of an 8-bit greyscale PNG file whose rows are not filtered, or filtered by "up".

    Args:
        data: Content of the file.
        size: Width and height that it must have [px].
        rows: Rows of the crop, within the image.
        columns: Columns of the crop, within the image.

    Returns:
        Crop (rows, columns) uint8; None: the file is of another kind or size, or damaged.
    """
    width, height = size
    stream = _join_data(data, width, height)
    if stream is None:
        return None
    length = height * (1 + width)
    try:
        raw = isal_zlib.decompressobj().decompress(stream, max_length=length)
    except isal_zlib.error:
        return None
    if len(raw) != length:
        return None
    lines = np.frombuffer(raw, np.uint8).reshape(height, 1 + width)
    filters = lines[: rows.stop, 0]
    if not np.isin(filters, (_NONE, _UP)).all():
        return None
    pixels = np.array(lines[: rows.stop, 1 + columns.start : 1 + columns.stop])
    # Each run of rows with the filter "up" adds to the row above, which has none.
    starts = np.flatnonzero(np.diff(filters == _UP, prepend=False, append=False)).tolist()
    for start, stop in zip(starts[::2], starts[1::2], strict=True):
        part = pixels[max(0, start - 1) : stop]
        np.add.accumulate(part, axis=0, out=part)
    return pixels[rows.start :]


def _join_data(data: bytes, width: int, height: int) -> bytes | None:
    """Compressed stream of an 8-bit greyscale file of that size; None: it is of another kind."""
    if len(data) < 33 or not data.startswith(_SIGNATURE) or data[12:16] != b"IHDR":
        return None
    if struct.unpack_from(">IIBBBBB", data, 16) != (width, height, *_GREY_8):
        return None
    parts, place = [], 33
    while place + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        if kind == b"IDAT":
            parts.append(data[place + 8 : place + 8 + length])
        elif kind[0] < ord("a"):  # Other chunks that a decoder must know, such as a palette, and the end.
            return b"".join(parts) if kind == b"IEND" else None
        place += 12 + length
    return None
