"""Image size from the header alone: Radiance and TIFF, which Pillow does not read in full, and what Pillow reads."""

from __future__ import annotations

import io
import re
import struct

from PIL import Image

from synpick_warp.scenes.assets.asset_files import quiet_decoding

MAX_HEADER = 2**16
"""Longest header of a Radiance file [bytes]."""
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "PPM", "JPEG2000")
_RESOLUTION = re.compile(rb"[-+]([XY])\s*\+?(\d{1,9})\s*[-+]([XY])\s*\+?(\d{1,9})")
_WIDTH, _HEIGHT = 256, 257
"""TIFF tags."""
_TIFF_TYPES = {3: "H", 4: "I"}


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of an image as its header gives them [px]; None for unknown formats and damaged headers."""
    if data[:2] == b"#?":
        return _radiance_size(data)
    if data[:4] in (b"II*\0", b"MM\0*"):
        return _tiff_size(data)
    with quiet_decoding():
        try:
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                return image.size
        except Image.DecompressionBombError:
            return 2**31, 2**31
        except Exception:  # Pillow raises nearly anything on damaged files
            return None


def _radiance_size(data: bytes) -> tuple[int, int] | None:
    """Size in a Radiance header: the largest in all lines up to the one after the empty line.

    OpenCV cuts long lines into pieces, so that it may take another line for the resolution than the first after the empty one.
    """
    empty = re.compile(rb"\n\r?\n").search(data, 0, MAX_HEADER)
    if empty is None:
        return None
    header = data[: max(data.find(b"\n", empty.end(), empty.end() + 256), empty.end())]
    # By the letter of the second axis: X is the width.
    found = ((int(first), int(second), axis) for _, first, axis, second in _RESOLUTION.findall(header))
    sizes = [(second, first) if axis == b"X" else (first, second) for first, second, axis in found]
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Size in the first directory of a TIFF file."""
    order = "<" if data[:2] == b"II" else ">"
    try:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        found = {}
        for entry in range(start + 2, start + 2 + 12 * count, 12):
            tag, kind = struct.unpack_from(f"{order}HH", data, entry)
            if tag in (_WIDTH, _HEIGHT) and kind in _TIFF_TYPES:
                (value,) = struct.unpack_from(f"{order}{_TIFF_TYPES[kind]}", data, entry + 8)
                found[tag] = max(value, found.get(tag, 0))
        return (found[_WIDTH], found[_HEIGHT]) if len(found) == 2 else None
    except struct.error:
        return None
