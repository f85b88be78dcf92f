"""A small PNG writer: one filter for all rows, ISA-L's deflate. Many times as fast as a writer that searches filters.

The same pixels give the same bytes, always, with one version of ISA-L on one kind of processor.
"""

from __future__ import annotations

import functools
import struct

import numpy as np
from isal import isal_zlib

from synpick_warp.exporters.writing.deflate import Deflater
from synpick_warp.exporters.writing.rle import Runs

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_UP = 2
"""Filter type of the PNG specification, section 9.2: minus the byte above. 0: the bytes as they are."""
_GREY, _RGB = 0, 2
"""Colour types of the PNG specification, table 11.1."""
_KINDS = (((), "uint8"), ((), "uint16"), ((3,), "uint8"), ((3,), "uint16"))
_ZLIB = b"\x78\x01"
"""How a zlib stream begins (RFC 1950, section 2.2): deflate, window of 32 kB, fastest compression."""
_LAST = b"\x03\x00"
"""An empty block with fixed codes, the last of its stream (RFC 1951, section 3.2.6)."""
_STRIP_BYTES = 1 << 18
"""Pixels that are filtered and compressed at once, about [B]: they and what becomes of them stay in a core's cache."""


def encode_png(image: np.ndarray) -> bytes:
    """An image as a PNG file.

    Args:
        image: Grey (H, W) or colour (H, W, 3), red first; uint8 or uint16.
    """
    if (image.shape[2:], image.dtype.name) not in _KINDS or not image.size:
        raise ValueError(f"no PNG for an image of shape {image.shape} and type {image.dtype}")
    height, width = image.shape[:2]
    row_bytes = image[0].nbytes
    strip = min(height, 1 + _STRIP_BYTES // row_bytes)
    # A strip below the row above it; above the image there are zeros.
    pixels = np.zeros((1 + strip, *image.shape[1:]), image.dtype.newbyteorder(">"))
    rows = pixels.view(np.uint8).reshape(1 + strip, row_bytes)
    filtered = np.empty((strip, 1 + row_bytes), np.uint8)
    filtered[:, 0] = _UP
    squeezer = Deflater()
    parts: list[bytes] = []
    for begin in range(0, height, strip):
        count = min(strip, height - begin)
        pixels[1 : 1 + count] = image[begin : begin + count]
        np.subtract(rows[1 : 1 + count], rows[:count], out=filtered[:count, 1:])
        parts.append(squeezer.compress(filtered[:count]))
        pixels[0] = pixels[count]
    stream = b"".join((*parts, squeezer.flush()))
    return _assemble(width, height, 8 * image.dtype.itemsize, _RGB if image.ndim == 3 else _GREY, stream)


def encode_mask_png(runs: Runs, height: int, width: int) -> bytes:
    """A mask as an 8-bit grey PNG file with values 0 and 255.

    With the filter "up", a mask's bytes are 0 but where a run begins or has ended. So only these are written, and only the rows in
    which there are any are compressed; what the rows above and below become is known.
    """
    stride = 1 + width
    ended = runs.past < height
    begins = runs.first * stride + 1 + runs.column
    ends = (runs.past * stride + 1 + runs.column)[ended]
    if not begins.size:
        return _assemble(width, height, 8, _GREY, _ZLIB + _zeros(height, stride) + _LAST + _checksum(height * stride, 0, 0))
    top, bottom = int(runs.first.min()), int(runs.past.max())
    rows = min(bottom + 1, height) - top
    canvas = _canvas(height, width)
    begins_here, ends_here = begins - top * stride, ends - top * stride
    canvas[begins_here], canvas[ends_here] = 255, 1
    squeezer = Deflater(-isal_zlib.MAX_WBITS)
    middle = squeezer.compress(canvas[: rows * stride]) + squeezer.flush(isal_zlib.Z_FULL_FLUSH)
    canvas[begins_here] = canvas[ends_here] = 0
    total = _UP * rows + 255 * begins.size + ends.size
    moment = _UP * stride * (rows * top + rows * (rows - 1) // 2) + 255 * int(begins.sum()) + int(ends.sum())
    above, below = _zeros(top, stride), _zeros(height - top - rows, stride)
    return _assemble(width, height, 8, _GREY, b"".join((_ZLIB, above, middle, below, _LAST, _checksum(height * stride, total, moment))))


@functools.cache
def _canvas(height: int, width: int) -> np.ndarray:
    """Filtered rows of a mask without pixels, but each with the filter "up". Whoever writes to it cleans up."""
    canvas = np.zeros((height, 1 + width), np.uint8)
    canvas[:, 0] = _UP
    return canvas.ravel()


def _zeros(rows: int, stride: int) -> bytes:
    """Raw deflate of so many rows of zero bytes, from a byte's beginning to a byte's end."""
    return b"".join(_zero_rows(1 << bit, stride) for bit in range(rows.bit_length()) if rows >> bit & 1)


@functools.cache
def _zero_rows(rows: int, stride: int) -> bytes:
    squeezer = Deflater(-isal_zlib.MAX_WBITS)
    return squeezer.compress(bytes(rows * stride)) + squeezer.flush(isal_zlib.Z_FULL_FLUSH)


def _checksum(count: int, total: int, moment: int) -> bytes:
    """Adler-32 (RFC 1950, section 8.2) of `count` bytes, from the sum of their values and the sum of position times value."""
    modulus = 65521
    return struct.pack(">I", (count + count * total - moment) % modulus << 16 | (1 + total) % modulus)


def _assemble(width: int, height: int, bits: int, color_type: int, stream: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0)
    return b"".join((_SIGNATURE, *_chunk(b"IHDR", header), *_chunk(b"IDAT", stream), *_chunk(b"IEND", b"")))


def _chunk(kind: bytes, data: bytes) -> tuple[bytes, bytes, bytes, bytes]:
    return struct.pack(">I", len(data)), kind, data, struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(kind)))
