"""Declaration of a setting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Any

Conflict = tuple[str, str]
"""Key of the wrong setting, and its allowed values."""
PATH_RULE = "a path in a file of settings is relative to that file"
"""For messages about what is missing."""
INT32_MAX = 2**31 - 1
"""Largest whole number of kernels and largest index of their arrays: the upper limit of settings that become one of them."""


def setting(
    default: Any,
    unit: str,
    doc: str,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] = (),
    parse: Callable[[Any], Any] | None = None,
    allowed: str = "",
    path: bool = False,
) -> Any:
    """Declare a setting: a dataclass field whose metadata are unit, meaning (one sentence) and allowed values.

    Args:
        default: Default value.
        unit: Unit; empty for dimensionless settings.
        doc: Help text.
        low: Minimum, inclusive; for tuples of each element, as are the others.
        high: Maximum, inclusive.
        above: Minimum, exclusive.
        choices: Allowed strings; empty: any.
        parse: Converts a value as TOML has it to one of the field's type; raises ValueError with what is allowed.
        allowed: What is allowed, where type, range and choices do not say it.
        path: Whether it names a file or folder; in a file of settings it is then relative to that file, else to the current folder.
    """
    metadata = {"unit": unit, "doc": doc, "low": low, "high": high, "above": above, "choices": choices, "parse": parse, "path": path}
    metadata["allowed"] = allowed
    return field(default=default, metadata=metadata)
