"""Text of mesh files: decoding from the encodings that exporters and editors write."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from synpick_warp.errors import CatalogError

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"))
_MARKS += ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_SAMPLE = 1024
_COMMA = re.compile(r"(?im)^[ \t]*(?=v|facet +normal|[-+.0-9]).*?(?<![\w,.])([-+]?[0-9]+,[0-9]+(?:e[-+]?[0-9]+)?)(?![\w.])")
"""Decimal comma in a line of coordinates."""


def check_decimals(text: str, path: Path) -> None:
    """Raise CatalogError if coordinates in an unreadable mesh file have decimal commas, as programs write them under some locales."""
    if (match := _COMMA.search(text)) is not None:
        raise CatalogError(f"{path}: its numbers have decimal commas, such as {match[1][:40]}; export it with decimal points")


def decode_text(data: bytes) -> str:
    """Decode text: UTF-8, UTF-16 or UTF-32 by its byte order mark, UTF-16 without one by its zeros, otherwise UTF-8, or Latin-1.

    Damaged characters of UTF-16 and UTF-32 are replaced; names and comments alone have any beyond ASCII.
    """
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return data.decode(encoding, "replace")
    start = data[:_SAMPLE]
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        # ASCII in UTF-16: every other byte is zero.
        if len(start) >= 4 and not any(start[first : len(start) // 2 * 2 : 2]) and all(start[1 - first : len(start) // 2 * 2 : 2]):
            return data.decode(encoding, "replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")
