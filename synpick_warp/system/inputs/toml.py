"""TOML decoding with limits on size, nesting and the length of dotted keys, where the standard library's parser is quadratic."""

from __future__ import annotations

import codecs
import re
import tomllib
from pathlib import Path
from typing import Any

from synpick_warp.errors import SynpickError
from synpick_warp.system.inputs.files import read_file

MAX_TOML = 2**20
"""Largest TOML file [bytes]; all settings with comments have 30 kB."""
MAX_KEY_PARTS = 8
"""Most parts of a dotted key; settings have two."""
_STRINGS = re.compile(r'"""(?:[^\\]|\\.)*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)|"(?:[^"\\\n]|\\.)*+"?|\'[^\'\n]*+\'?|#[^\n]*+', re.DOTALL)
"""Strings and comments, which may be left unclosed. Both patterns take linear time."""
_LONG_KEY = re.compile(rf"(?<![\w'-])(?:[\w'-]++[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}")
"""A key of more than MAX_KEY_PARTS parts."""


def decode_toml(text: str) -> dict[str, Any]:
    """Decode TOML. Raises ValueError: the text is not TOML, or exceeds a limit; the message says which."""
    if _LONG_KEY.search(_STRINGS.sub("''", text)):
        raise ValueError(f"a key has more than {MAX_KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # Python's limit on decimal digits; its message advises programmers.
        raise ValueError("a number has more digits than any setting") from None


def read_toml(path: Path, error: type[SynpickError]) -> dict[str, Any]:
    """Read a TOML file, with a byte order mark or without. Raises SynpickError: as `error`, in one line: it cannot be read, is too large,
    is not UTF-8, or is not TOML."""
    data = read_file(path, MAX_TOML, error)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in data[:4]:
        raise error(f"{path} is text in UTF-16 or UTF-32, which TOML does not allow; save it as UTF-8")
    try:
        return decode_toml(data.decode("utf-8-sig"))
    except UnicodeDecodeError as fault:
        raise error(f"{path} is not valid TOML: byte {fault.start} is not UTF-8") from None
    except ValueError as fault:
        text = str(fault)
        raise error(f"{path} is not valid TOML: {text[:1].lower()}{text[1:]}") from None
