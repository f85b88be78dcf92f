"""Baseline JPEG (ITU-T T.81) with 4:2:0 chroma and restart intervals: encoder by libjpeg (OpenCV), and the tables of the one on the device.

Both give the same bytes. Restart intervals, which the device codes in parallel, cost 0.2 % of a file's size.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np

RESTART_INTERVAL = 32
"""Minimum coded units (MCUs, 16 x 16 px) of a restart interval: 255 intervals at full HD."""
QUALITIES = 101
"""Qualities 0 to 100; 0 is taken for 1."""
DIVISOR_SCALE = 8
"""Scale of the integer DCT's coefficients."""
_LUMA = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)
"""Quantization of Y at quality 50 (table K.1)."""
_CHROMA = (
    (17, 18, 24, 47, 99, 99, 99, 99),
    (18, 21, 26, 66, 99, 99, 99, 99),
    (24, 26, 56, 99, 99, 99, 99, 99),
    (47, 66, 99, 99, 99, 99, 99, 99),
    *((99,) * 8,) * 4,
)
"""Quantization of Cb and Cr at quality 50 (table K.2)."""
DC_COUNTS = (bytes.fromhex("00010501010101010100000000000000"), bytes.fromhex("00030101010101010101010000000000"))
"""Number of DC codes of 1 to 16 bits, of Y and of Cb and Cr (tables K.3, K.4)."""
DC_SYMBOLS = (bytes(range(12)), bytes(range(12)))
AC_COUNTS = (bytes.fromhex("0002010303020403050504040000017d"), bytes.fromhex("00020102040403040705040400010277"))
"""The same of AC codes (tables K.5, K.6)."""
AC_SYMBOLS = (
    bytes.fromhex(
        "01020300041105122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25262728292a3435363738393a"
        "434445464748494a535455565758595a636465666768696a737475767778797a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aa"
        "b2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa"
    ),
    bytes.fromhex(
        "0001020311040521310612415107617113223281081442 91a1b1c109233352f0156272d10a162434e125f11718191a262728292a35363738393a"
        "434445464748494a535455565758595a636465666768696a737475767778797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aa"
        "b2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa".replace(" ", "")
    ),
)
_APP0 = bytes.fromhex("4a46494600010100000100010000")
"""JFIF 1.01, square pixels, no thumbnail."""
_COMPONENTS = bytes.fromhex("03012200021101031101")
"""Y with 2 x 2 blocks and table 0, Cb and Cr with one block and table 1."""
_SCAN = bytes.fromhex("03010002110311003f00")
"""All three components interleaved, all coefficients at once."""


def encode_jpeg(image: np.ndarray, quality: int) -> memoryview:
    """Encode an RGB image (H, W, 3) uint8 by libjpeg."""
    settings = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_RST_INTERVAL, RESTART_INTERVAL)
    encoded, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    if not encoded:
        raise ValueError(f"OpenCV cannot encode an image of shape {image.shape} as JPEG")
    return data.data


def zigzag_order() -> np.ndarray:
    """Row-major index of each coefficient in zigzag order (64) int32."""
    rows, columns = np.divmod(np.arange(64), 8)
    diagonal = rows + columns
    return np.lexsort((np.where(diagonal % 2, rows, columns), diagonal)).astype(np.int32)


def quantization(quality: int) -> np.ndarray:
    """Divisors of Y and of Cb and Cr (2, 64) int32 in zigzag order, 1 to 255: libjpeg's jpeg_set_quality."""
    quality = min(max(quality, 1), 100)
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    tables = np.array((_LUMA, _CHROMA), np.int32).reshape(2, 64)[:, zigzag_order()]
    return np.clip((tables * scale + 50) // 100, 1, 255).astype(np.int32)


def reciprocals(divisors: np.ndarray) -> np.ndarray:
    """2^32 / divisor, rounded up, uint32; divisors are at least 2."""
    return (-(-(1 << 32) // divisors.astype(np.int64))).astype(np.uint32)


def huffman_codes(counts: bytes, symbols: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Canonical Huffman codes (T.81, annex C): code (256) uint32 and length (256) int32 [bits] by symbol; length 0: no code."""
    codes, lengths = np.zeros(256, np.uint32), np.zeros(256, np.int32)
    code, index = 0, 0
    for length, count in enumerate(counts, start=1):
        for symbol in symbols[index : index + count]:
            codes[symbol], lengths[symbol] = code, length
            code += 1
        index += count
        code <<= 1
    return codes, lengths


def make_header(width: int, height: int, quality: int) -> bytes:
    """All that precedes the entropy-coded data of an image, with restart intervals."""
    parts = [b"\xff\xd8", _segment(0xE0, _APP0)]
    for index, table in enumerate(quantization(quality)):
        parts.append(_segment(0xDB, bytes([index, *table.tolist()])))
    parts.append(_segment(0xC0, struct.pack(">BHH", 8, height, width) + _COMPONENTS))
    for index in range(2):
        parts.append(_segment(0xC4, bytes([index]) + DC_COUNTS[index] + DC_SYMBOLS[index]))
        parts.append(_segment(0xC4, bytes([0x10 + index]) + AC_COUNTS[index] + AC_SYMBOLS[index]))
    parts.append(_segment(0xDD, struct.pack(">H", RESTART_INTERVAL)))
    parts.append(_segment(0xDA, _SCAN))
    return b"".join(parts)


def _segment(marker: int, payload: bytes) -> bytes:
    """JPEG segment: marker, length, payload."""
    return struct.pack(">BBH", 0xFF, marker, len(payload) + 2) + payload
