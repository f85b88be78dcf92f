"""PNG encoder with the fixed "up" filter and ISA-L's deflate: many times as fast as encoders that search a filter for each row.

Equal pixels give equal bytes with one version of ISA-L on one type of CPU.
"""

import functools
import hashlib
import struct

import numpy as np
from isal import isal_zlib

from synpick_warp.exporters.writing.files import Buffer
from synpick_warp.exporters.writing.rle import Runs, cached_by_runs

LEVEL = 1
"""ISA-L's level: on depth images, 0 makes files a third larger in the same time, 3 takes twice as long and gains nothing."""
HEAD = 16
"""Number of first bytes that are flushed separately: ISA-L handles all of them, and at least four, by its code for the last bytes."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_UP = 2
"""Filter type "up" of the PNG specification, section 9.2: difference to the byte above. (0 would be "none".)"""
_GREY, _RGB = 0, 2
"""Colour types of the PNG specification, table 11.1."""
_FORMATS = (((), "uint8"), ((), "uint16"), ((3,), "uint8"), ((3,), "uint16"))
"""Supported (shape of a pixel, type)."""
_ZLIB_HEADER = b"\x78\x01"
"""Header of a zlib stream (RFC 1950, section 2.2): deflate, window of 32 kB, fastest compression."""
_FINAL_BLOCK = b"\x03\x00"
"""Empty final deflate block with fixed Huffman codes (RFC 1951, section 3.2.6)."""
_CACHED_HEIGHTS = 4096
"""Heights of blank rows whose compressed form is cached, at most: those of full HD take 1.3 MB in all."""
_STRIP_BYTES = 1 << 18
"""Approximate size of a strip of rows that is filtered and compressed at once [B]: input and output fit in a core's cache."""


class Deflater:
    """Compressor of one deflate stream by ISA-L: equal data gives equal bytes in every process.

    ISA-L's fast levels insert one of a stream's first positions into their match table by the hash of a register that holds the stream's
    address (write_first_byte in igzip_icf_body_h1_gr_bt.asm, version 2.31). So a few streams in a thousand are compressed differently when
    the memory layout differs. The code path for the last bytes before a flush has no such fault; the first bytes are sent through it.
    """

    def __init__(self, window_bits: int = isal_zlib.MAX_WBITS) -> None:
        """`window_bits` is zlib's: negative for a raw stream without header and checksum."""
        self._stream = isal_zlib.compressobj(LEVEL, isal_zlib.DEFLATED, window_bits)
        self._started = False

    def compress(self, data: bytes | np.ndarray) -> bytes:
        """Compress C-contiguous bytes. The first call must get at least HEAD of them, or all there are."""
        view = memoryview(data if isinstance(data, bytes) else data.data).cast("B")
        if self._started:
            return self._stream.compress(view)
        self._started = True
        head = self._stream.compress(view[:HEAD]) + self._stream.flush(isal_zlib.Z_SYNC_FLUSH)
        return head + self._stream.compress(view[HEAD:])

    def flush(self, mode: int = isal_zlib.Z_FINISH) -> bytes:
        """Return the pending output; by default finishes the stream."""
        return self._stream.flush(mode)


def encode_png(image: np.ndarray) -> bytes:
    """Encode an image, greyscale (H, W) or RGB (H, W, 3), uint8 or uint16, as a PNG file."""
    if (image.shape[2:], image.dtype.name) not in _FORMATS or not image.size:
        raise ValueError(f"no PNG for an image of shape {image.shape} and type {image.dtype}")
    height, width = image.shape[:2]
    row_bytes = image[0].nbytes
    strip = min(height, 1 + _STRIP_BYTES // row_bytes)
    # Row 0 holds the row above the strip; above the image it is zero.
    pixels = np.zeros((1 + strip, *image.shape[1:]), image.dtype.newbyteorder(">"))
    rows = pixels.view(np.uint8).reshape(1 + strip, row_bytes)
    filtered = np.empty((strip, 1 + row_bytes), np.uint8)
    filtered[:, 0] = _UP
    stream = Deflater()
    parts: list[bytes] = []
    for begin in range(0, height, strip):
        count = min(strip, height - begin)
        pixels[1 : 1 + count] = image[begin : begin + count]
        np.subtract(rows[1 : 1 + count], rows[:count], out=filtered[:count, 1:])
        parts.append(stream.compress(filtered[:count]))
        pixels[0] = pixels[count]
    data = b"".join((*parts, stream.flush()))
    return _assemble(width, height, 8 * image.dtype.itemsize, _RGB if image.ndim == 3 else _GREY, data)


def frame_depth_png(data: Buffer, width: int, height: int) -> bytes:
    """A 16-bit greyscale PNG file from its data (IDAT): a zlib stream of filtered rows."""
    return _assemble(width, height, 16, _GREY, data)


def encode_mask_png(runs: Runs, height: int, width: int) -> bytes:
    """Encode a mask as an 8-bit greyscale PNG file with values 0 and 255, without painting its pixels.

    Under the "up" filter, all bytes of a mask are 0 except where a run starts (255) and below its end (1). So only these bytes are
    set, and only the rows that hold any are compressed; the compressed form of blank rows is cached.
    """
    stride = 1 + width
    count = runs.column.size
    if not count:
        data = (_ZLIB_HEADER, _blank_rows(height, stride), _FINAL_BLOCK, _adler32(height * stride, 0, 0))
        return _assemble(width, height, 8, _GREY, b"".join(data))
    rows = min(runs.bottom + 1, height) - runs.top
    canvas = _canvas(height, width)
    skipped = runs.top * stride
    begins = runs.first * stride
    begins += runs.column
    begins += 1 - skipped
    ends = begins + (runs.past - runs.first) * stride
    canvas[begins], canvas[ends] = 255, 1
    stream = Deflater(-isal_zlib.MAX_WBITS)
    middle = stream.compress(canvas[: rows * stride]) + stream.flush(isal_zlib.Z_FULL_FLUSH)
    canvas[begins] = canvas[ends] = 0
    # Sums of positions in the window. A run that ends at the image's bottom sets no byte below it.
    begin_sum = int(begins.sum())
    end_sum, end_count = begin_sum + stride * runs.count, count
    if runs.bottom == height:
        outside = ends[runs.past == height]
        end_sum, end_count = end_sum - int(outside.sum()), count - outside.size
    total = 255 * count + end_count
    moment = 255 * begin_sum + end_sum + skipped * total
    moment += _UP * stride * (rows * runs.top + rows * (rows - 1) // 2)
    total += _UP * rows
    above, below = _blank_rows(runs.top, stride), _blank_rows(height - runs.top - rows, stride)
    data = b"".join((_ZLIB_HEADER, above, middle, below, _FINAL_BLOCK, _adler32(height * stride, total, moment)))
    return _assemble(width, height, 8, _GREY, data)


@cached_by_runs
def hashed_mask_png(runs: Runs, height: int, width: int) -> tuple[bytes, str]:
    """File of `encode_mask_png`, and its SHA-256 in hexadecimal."""
    data = encode_mask_png(runs, height, width)
    return data, hashlib.sha256(data).hexdigest()


@functools.cache
def _canvas(height: int, width: int) -> np.ndarray:
    """Scratch buffer: filtered rows of an empty mask, each with its filter byte. A caller that changes it restores it.

    One row more than the image takes the ends of runs at the image's bottom.
    """
    canvas = np.zeros((height + 1, 1 + width), np.uint8)
    canvas[:, 0] = _UP
    return canvas.ravel()


@functools.lru_cache(_CACHED_HEIGHTS)
def _blank_rows(rows: int, stride: int) -> bytes:
    """Raw deflate of `rows` rows of zero bytes, byte-aligned at both ends; concatenated from cached powers of two."""
    return b"".join(_zero_rows(1 << bit, stride) for bit in range(rows.bit_length()) if rows >> bit & 1)


@functools.cache
def _zero_rows(rows: int, stride: int) -> bytes:
    """Deflated bytes of rows of zeros that end at a byte, so that other data can follow."""
    stream = Deflater(-isal_zlib.MAX_WBITS)
    return stream.compress(bytes(rows * stride)) + stream.flush(isal_zlib.Z_FULL_FLUSH)


def _adler32(count: int, total: int, moment: int) -> bytes:
    """Adler-32 (RFC 1950, section 8.2) of `count` bytes, from Σ value (`total`) and Σ position · value (`moment`)."""
    modulus = 65521
    return struct.pack(">I", (count + count * total - moment) % modulus << 16 | (1 + total) % modulus)


def _assemble(width: int, height: int, bits: int, color_type: int, data: Buffer) -> bytes:
    return b"".join((_head(width, height, bits, color_type), *_chunk(b"IDAT", data), _END))


@functools.cache
def _head(width: int, height: int, bits: int, color_type: int) -> bytes:
    """Signature and header chunk (IHDR) of a PNG file."""
    return b"".join((_SIGNATURE, *_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0))))


def _chunk(kind: bytes, data: Buffer) -> tuple[bytes, bytes, Buffer, bytes]:
    """Parts of a PNG chunk: length, kind, data, CRC."""
    return struct.pack(">I", len(data)), kind, data, struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(kind)))


_END = b"".join(_chunk(b"IEND", b""))
"""Last chunk of a file."""
