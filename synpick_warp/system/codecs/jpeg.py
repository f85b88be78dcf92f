"""Baseline JPEG (ITU-T T.81) with 4:2:0 chroma and restart intervals: encoder by libjpeg (OpenCV), and its tables for the device's.

Both give the same bytes. Restart intervals, which the device codes in parallel, cost 0.2 % of a file's size.
"""

import functools
import itertools
import struct

import cv2
import numpy as np

RESTART_INTERVAL = 32
"""Minimum coded units (MCUs, 16 x 16 px) of a restart interval: 255 intervals at full HD."""
QUALITIES = 101
"""Qualities 0 to 100; 0 is taken for 1."""
DIVISOR_SCALE = 8
"""Scale of the integer DCT's coefficients."""
_FRAME, _HUFFMAN, _SCAN, _QUANTIZATION = 0xFFC0, 0xFFC4, 0xFFDA, 0xFFDB
"""Markers of segments (T.81, table B.1)."""


def encode_jpeg(image: np.ndarray, quality: int) -> memoryview:
    """Encode an RGB image (H, W, 3) uint8 by libjpeg."""
    settings = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_RST_INTERVAL, RESTART_INTERVAL)
    encoded, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    if not encoded:
        raise ValueError(f"OpenCV cannot encode an image of shape {image.shape} as JPEG")
    return data.data


@functools.cache
def _segments(quality: int) -> tuple[tuple[int, bytes], ...]:
    """Marker and content of each segment before the entropy-coded data, as libjpeg writes them; only the frame's depend on the image."""
    data, place, segments = bytes(encode_jpeg(np.zeros((1, 1, 3), np.uint8), quality)), 2, []
    while not segments or segments[-1][0] != _SCAN:
        marker, size = struct.unpack_from(">HH", data, place)
        segments.append((marker, data[place + 4 : place + 2 + size]))
        place += 2 + size
    return tuple(segments)


def quantization(quality: int) -> np.ndarray:
    """Divisors of Y and of Cb and Cr (2, 64) int32 in zigzag order, 1 to 255."""
    return np.array([list(content[1:]) for marker, content in _segments(quality) if marker == _QUANTIZATION], np.int32)


def reciprocals(divisors: np.ndarray) -> np.ndarray:
    """2^32 / divisor, rounded up, uint32; divisors are at least 2."""
    return (-(-(1 << 32) // divisors.astype(np.int64))).astype(np.uint32)


def huffman_codes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Canonical Huffman codes (T.81, annexes C and K) of "dc" and "ac", of Y and of Cb and Cr: code (2, 256) uint32 and length (2, 256)
    int32 [bits] by symbol; length 0: no code."""
    codes, lengths = np.zeros((2, 2, 256), np.uint32), np.zeros((2, 2, 256), np.int32)
    for content in (content for marker, content in _segments(0) if marker == _HUFFMAN):
        table, symbols, code = divmod(content[0], 16), iter(content[17:]), 0
        for length, count in enumerate(content[1:17], start=1):
            for symbol in itertools.islice(symbols, count):
                codes[*table, symbol], lengths[*table, symbol] = code, length
                code += 1
            code <<= 1
    return {kind: (codes[index], lengths[index]) for index, kind in enumerate(("dc", "ac"))}


def make_header(width: int, height: int, quality: int) -> bytes:
    """All that precedes the entropy-coded data of an image, with restart intervals."""
    parts = [b"\xff\xd8"]
    for marker, content in _segments(quality):
        if marker == _FRAME:
            content = content[:1] + struct.pack(">HH", height, width) + content[5:]
        parts.append(struct.pack(">HH", marker, len(content) + 2) + content)
    return b"".join(parts)
