"""Image size from the header alone: Radiance and TIFF, which Pillow does not read in full, and what Pillow reads."""

from __future__ import annotations

import io
import re

from PIL import Image

from synpick_warp.scenes.assets.asset_files import quiet_decoding
from synpick_warp.system.inputs.image_files import tiff_size

MAX_HEADER = 2**16
"""Longest header of a Radiance file [bytes]."""
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "PPM", "JPEG2000")
_RESOLUTION = re.compile(rb"[-+]([XY])\s*\+?(\d{1,9})\s*[-+]([XY])\s*\+?(\d{1,9})")


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of an image as its header gives them [px]; None for unknown formats and damaged headers."""
    if data[:2] == b"#?":
        return _radiance_size(data)
    if data[:4] in (b"II*\0", b"MM\0*"):
        return tiff_size(data)
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
