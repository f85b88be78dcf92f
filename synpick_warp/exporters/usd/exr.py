"""A small OpenEXR writer for light maps: linear RGB in 32-bit floats, whole scan lines, ZIP. The same pixels give the same bytes.

USD's core knows textures as EXR, PNG and JPEG, and Radiance maps only where a renderer happens to read them.
"""

from __future__ import annotations

import struct

import numpy as np

from synpick_warp.exporters.writing.deflate import deflate

_MAGIC, _VERSION = 20000630, 2
"""First words of a file of one part with scan lines (openexr.com/en/latest/OpenEXRFileLayout.html)."""
_FLOAT = 2
"""Pixel type: 32-bit float."""
_ZIP, _ROWS = 3, 16
"""Compression, and the rows that it packs together."""


def encode_exr(image: np.ndarray) -> bytes:
    """An image as an OpenEXR file that is marked as a map of longitude and latitude.

    Args:
        image: Linear RGB (H, W, 3) float32.
    """
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ValueError(f"no EXR for an image of shape {image.shape}")
    height, width = image.shape[:2]
    # Channels are stored by name, B, G, R, each a row at a time.
    lines = np.ascontiguousarray(image[..., ::-1].transpose(0, 2, 1), dtype="<f4")
    blocks = [_block(row, lines[row : row + _ROWS]) for row in range(0, height, _ROWS)]
    head = _header(width, height)
    places = np.cumsum([len(head) + 8 * len(blocks), *(len(block) for block in blocks[:-1])])
    return b"".join((head, places.astype("<u8").tobytes(), *blocks))


def _header(width: int, height: int) -> bytes:
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channels = b"".join(name + b"\0" + struct.pack("<iB3xii", _FLOAT, 0, 1, 1) for name in (b"B", b"G", b"R"))
    attributes = (
        (b"channels", b"chlist", channels + b"\0"),
        (b"compression", b"compression", bytes([_ZIP])),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"envmap", b"envmap", b"\0"),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1.0)),
    )
    parts = (name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value for name, kind, value in attributes)
    return struct.pack("<2i", _MAGIC, _VERSION) + b"".join(parts) + b"\0"


def _block(row: int, lines: np.ndarray) -> bytes:
    """Some rows: even bytes before odd ones, differences of neighbours, deflate; or as they are if that is no shorter."""
    plain = lines.reshape(-1).view(np.uint8)
    sorted_bytes = np.concatenate((plain[0::2], plain[1::2]))
    steps = sorted_bytes.copy()
    steps[1:] -= sorted_bytes[:-1]
    steps[1:] += np.uint8(128)
    packed = deflate(steps)
    data = packed if len(packed) < plain.size else plain.tobytes()
    return struct.pack("<2i", row, len(data)) + data
