"""Radiance files (.hdr, .pic): header variants that OpenCV does not read, rewritten to the one that it does (Ward, 1991).

Programs differ in the first line, comments, the order and presence of FORMAT, and the direction of scanlines; the pixels are coded alike.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synpick_warp.errors import LightError

MAX_HEADER = 2**16
"""Longest header [bytes]."""
_RESOLUTION = re.compile(rb"([-+])([XY])\s+(\d{1,9})\s+([-+])([XY])\s+(\d{1,9})\s*")
_RGBE, _XYZE = b"32-bit_rle_rgbe", b"32-bit_rle_xyze"


@dataclass(frozen=True)
class RadianceHeader:
    """Size, orientation and exposure of the pixels of a Radiance file, as its header states."""

    width: int
    """[px]"""
    height: int
    transposed: bool
    """Scanlines are columns."""
    flip_rows: bool
    """The first row is the lowest."""
    flip_columns: bool
    """The first column is the rightmost."""
    exposure: float
    """Factor by which radiances were multiplied."""


def canonical_radiance(data: bytes, path: Path) -> tuple[bytes, RadianceHeader] | None:
    """Rewrite the header of a Radiance file: magic, FORMAT, scanlines from the top, from left to right.

    Args:
        data: The file.
        path: Its path, for errors.

    Returns:
        The file with another header, whose image `orient_radiance` turns; and what the header said. None: it has no such header.

    Raises:
        LightError: The colours are not RGB.
    """
    lines, at = [], 0
    while (end := data.find(b"\n", at, MAX_HEADER)) >= 0:
        line = data[at:end].rstrip(b"\r")
        at = end + 1
        match = _RESOLUTION.fullmatch(line)
        if match is not None:
            break
        lines.append(line)
    else:
        return None
    first_sign, first, first_size, second_sign, second, second_size = match.groups()
    if first == second:
        return None
    kinds = [line.partition(b"=")[2].strip().lower() for line in lines if line.upper().startswith(b"FORMAT=")]
    if _XYZE in kinds:
        raise LightError(f"{path} has XYZ colours (32-bit_rle_xyze), which are not read; convert it to RGB")
    if kinds and kinds[-1] != _RGBE:
        return None
    transposed = first == b"X"
    signs = {first: first_sign, second: second_sign}
    count, length = int(first_size), int(second_size)
    width, height = (count, length) if transposed else (length, count)
    head = b"#?RADIANCE\nFORMAT=%s\n\n-Y %d +X %d\n" % (_RGBE, count, length)
    return head + data[at:], RadianceHeader(width, height, transposed, signs[b"Y"] == b"+", signs[b"X"] == b"-", _exposure(lines))


def _exposure(lines: list[bytes]) -> float:
    """Product of all EXPOSURE lines; those that are no positive number count as 1."""
    exposure = 1.0
    for line in lines:
        if line.upper().startswith(b"EXPOSURE="):
            try:
                value = float(line[9:])
            except ValueError:
                continue
            if 0.0 < value < float("inf"):
                exposure *= value
    return exposure if 0.0 < exposure < float("inf") else 1.0


def orient_radiance(image: np.ndarray, header: RadianceHeader) -> np.ndarray:
    """Turn the image of a rewritten file to rows from the top and columns from the left, and divide by the exposure."""
    if header.transposed:
        image = image.swapaxes(0, 1)
    if header.flip_rows:
        image = image[::-1]
    if header.flip_columns:
        image = image[:, ::-1]
    return image if header.exposure == 1.0 else image / np.float32(header.exposure)
