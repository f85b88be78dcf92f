"""Part counts of an episode's bin (`arrangement.counts`): parsing of the table of parts and their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from synpick_warp.configs.fields import INT32_MAX

Counts = tuple[tuple[str, int, int], ...]
"""Part, least and largest number of it, each part once."""
COUNTS = "a table of parts with their numbers, or least and largest numbers: { bracket = 12 } or { bolt = [4, 8], nut = 8 }"


def parse_counts(value: Any) -> Any:
    """Lists [part, least, most] of a table; such lists, which config.toml has, stay as they are.

    Raises:
        ValueError: It is none, a number is not allowed, or a part comes twice.
    """
    rows = [[name, *_limits(number)] for name, number in value.items()] if isinstance(value, Mapping) else value
    if not isinstance(rows, list | tuple) or not all(isinstance(row, list | tuple) and len(row) == 3 for row in rows):
        raise ValueError(COUNTS)
    if not all(isinstance(row[0], str) and row[0] and all(type(number) is int for number in row[1:]) for row in rows):
        raise ValueError(COUNTS)
    if not all(0 <= low <= high <= INT32_MAX and high > 0 for _, low, high in rows):
        raise ValueError("numbers of at least 1, or [least, most] with least at most most")
    if len({row[0] for row in rows}) < len(rows):
        raise ValueError("each part once")
    return rows


def _limits(number: Any) -> Sequence[Any]:
    """Least and largest number; a single one is both."""
    return number if isinstance(number, list | tuple) else (number, number)


def most_objects(counts: Counts) -> int:
    """Largest number of an episode's objects."""
    return sum(most for _, _, most in counts)
