"""How a setting is declared."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def setting(
    default: Any,
    unit: str,
    doc: str,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """A dataclass field that knows its unit, its meaning and what values it takes.

    `low` and `high` include their end; `above` excludes it. For tuples the bounds hold for each element.
    """
    metadata = {"unit": unit, "doc": doc, "low": low, "high": high, "above": above, "choices": choices}
    return field(default=default, metadata=metadata)
