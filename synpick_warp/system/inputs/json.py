"""JSON decoding with a schema: msgspec types, with path and position of the first mismatch in the error.

Numbers are finite, integers fit into 64 bits unless declared otherwise, nesting ends at Python's recursion limit.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from synpick_warp.errors import SynpickError
from synpick_warp.system.inputs.files import read_file

MAX_JSON = 2**29
"""Largest JSON file [bytes]; the annotations of a long episode at full HD have some 10 MB."""
_Content = TypeVar("_Content")


def decode_json(data: bytes, schema: type[_Content], source: object, error: type[SynpickError], advice: str = "") -> _Content:
    """Decode JSON and validate it against a schema.

    Args:
        schema: Type of the content as msgspec understands it: a Struct, a TypedDict, `dict[str, int]`, `Any`.
        source: Where it comes from, for messages: a path, or a path with a line number.
        advice: End of the message: what to do.

    Raises SynpickError: as `error`, in one line: not JSON, or not of this schema."""
    try:
        return msgspec.json.decode(data, type=schema)
    except (ValueError, RecursionError) as fault:  # msgspec's errors are ValueErrors.
        raise error(f"{source} is damaged: {_describe(fault)}{advice and f'; {advice}'}") from None


def read_json(path: Path, schema: type[_Content], error: type[SynpickError], advice: str = "", limit: int = MAX_JSON) -> _Content:
    """Read and validate a JSON file; arguments and errors as `decode_json` and `read_file`."""
    return decode_json(read_file(path, limit, error), schema, path, error, advice)


def _describe(fault: Exception) -> str:
    """Text of a decoding error for a message, as part of a sentence."""
    text: Any = "nested too deeply" if isinstance(fault, RecursionError) else str(fault).replace("`", "")
    return text if text.startswith("JSON") else f"{text[:1].lower()}{text[1:]}"
