"""PNG decoder for greyscale images and crops of masks: inflates with ISA-L and undoes the "up" filter of the crop's columns only.

Several times as fast as OpenCV's for a crop, twice as fast for a whole depth image. Files with other filters, types or interlacing are
left to OpenCV, as are damaged ones.
"""

import struct
from itertools import pairwise

import numpy as np
from isal import isal_zlib

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY = (0, 0, 0, 0)
"""Colour type, compression, filter method and interlacing of greyscale (PNG specification, section 11.2.2)."""
_NONE, _UP = b"\0", b"\2"
"""Filter types of the PNG specification, section 9.2."""
_HARMLESS = (b"tEXt", b"pHYs", b"tIME")
"""Optional chunks that are passed over; others may change the image, such as transparency, orientation or animation."""
_WIDE = 512
"""Width from which rows are added one by one: NumPy adds a row at a time faster, but a call costs as much as some 500 bytes [B]."""


def decode_grey_crop(data: bytes, size: tuple[int, int], rows: slice, columns: slice, bits: int = 8) -> np.ndarray | None:
    """Decode a crop of a greyscale PNG file whose rows are not filtered, or filtered by "up". `data`: content of the file. `size`: width
    and height that it must have [px]. `rows`, `columns`: of the crop, within the image. `bits`: bit depth that it must have: 8 or 16.
    Returns the crop (rows, columns), uint8 or big-endian uint16; None: the file is of another kind or size, or damaged."""
    width, height = size
    stream = _join_data(data, width, height, bits)
    if stream is None:
        return None
    itemsize = bits // 8
    stride = 1 + width * itemsize
    inflater = isal_zlib.decompressobj()
    try:
        # The first row's filter tells soon that a file is of another kind.
        first = inflater.decompress(stream, max_length=1)
        if first not in (_NONE, _UP):
            return None
        raw = first + inflater.decompress(inflater.unconsumed_tail, max_length=height * stride - 1)
    except isal_zlib.error:
        return None
    if len(raw) != height * stride:
        return None
    filters = raw[: rows.stop * stride : stride]
    if filters.strip(_UP) and filters.translate(None, _NONE + _UP):
        return None
    lines = np.frombuffer(raw, np.uint8).reshape(height, stride)
    pixels = lines[: rows.stop, 1 + columns.start * itemsize : 1 + columns.stop * itemsize].copy()
    # Each run of rows with the filter "up" adds to the row above, which has none.
    stop = 0
    while (start := filters.find(_UP, stop)) >= 0:
        stop = filters.find(_NONE, start)
        stop = len(filters) if stop < 0 else stop
        part = pixels[max(0, start - 1) : stop]
        if part.shape[1] < _WIDE:
            np.add.accumulate(part, axis=0, out=part)
            continue
        for above, row in pairwise(part):
            np.add(above, row, out=row)
    return pixels[rows.start :].view(">u2" if bits == 16 else np.uint8)


def _join_data(data: bytes, width: int, height: int, bits: int) -> bytes | None:
    """Compressed stream of a greyscale file of that size and bit depth; None: it is of another kind, or a checksum is wrong."""
    if len(data) < 33 or not data.startswith(_SIGNATURE) or data[12:16] != b"IHDR":
        return None
    header = struct.unpack_from(">IIBBBBBI", data, 16)
    if header != (width, height, bits, *_GREY, isal_zlib.crc32(data[12:29])):
        return None
    parts, place = [], 33
    while place + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        end = place + 8 + length
        if kind == b"IDAT":
            # The checksum is of the chunk's name and content.
            if data[end : end + 4] != isal_zlib.crc32(data[place + 4 : end]).to_bytes(4, "big"):
                return None
            parts.append(data[place + 8 : end])
        elif kind not in _HARMLESS:
            return b"".join(parts) if kind == b"IEND" else None
        place = end + 4
    return None
