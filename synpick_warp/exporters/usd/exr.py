"""OpenEXR encoder for environment maps: linear RGB, 32-bit floats, scan lines, ZIP compression. Equal pixels give equal bytes.

USD's core supports EXR, PNG and JPEG textures; Radiance maps (.hdr) are supported by some renderers only.
"""

from __future__ import annotations

import struct

import numpy as np

from synpick_warp.exporters.writing.deflate import deflate

_MAGIC, _VERSION = 20000630, 2
"""Magic number and version of a single-part file of scan lines (openexr.com/en/latest/OpenEXRFileLayout.html)."""
_FLOAT = 2
"""Pixel type: 32-bit float."""
_ZIP, _ROWS = 3, 16
"""Compression method, and the number of rows per compressed block."""


def encode_exr(image: np.ndarray) -> bytes:
    """Encode an image as an OpenEXR file marked as a latitude-longitude environment map.

    Args:
        image: Linear RGB (H, W, 3) float32.
    """
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ValueError(f"no EXR for an image of shape {image.shape}")
    height, width = image.shape[:2]
    # Channels are stored in order of names (B, G, R), row by row.
    lines = np.ascontiguousarray(image[..., ::-1].transpose(0, 2, 1), dtype="<f4")
    blocks = [_block(row, lines[row : row + _ROWS]) for row in range(0, height, _ROWS)]
    head = _header(width, height)
    offsets = np.cumsum([len(head) + 8 * len(blocks), *(len(block) for block in blocks[:-1])])
    return b"".join((head, offsets.astype("<u8").tobytes(), *blocks))


def _header(width: int, height: int) -> bytes:
    """Header of an OpenEXR file: latitude-longitude map of float channels, ZIP compression."""
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
    parts = (name + b"\0" + type_name + b"\0" + struct.pack("<i", len(value)) + value for name, type_name, value in attributes)
    return struct.pack("<2i", _MAGIC, _VERSION) + b"".join(parts) + b"\0"


def _block(row: int, lines: np.ndarray) -> bytes:
    """Encode a block of rows: even bytes before odd ones, differences of neighbours, deflate; uncompressed if that is no shorter."""
    plain = lines.reshape(-1).view(np.uint8)
    reordered = np.concatenate((plain[0::2], plain[1::2]))
    deltas = reordered.copy()
    deltas[1:] -= reordered[:-1]
    deltas[1:] += np.uint8(128)
    packed = deflate(deltas)
    data = packed if len(packed) < plain.size else plain.tobytes()
    return struct.pack("<2i", row, len(data)) + data
