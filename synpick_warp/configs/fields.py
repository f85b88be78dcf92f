"""Declaration of a setting: a dataclass field whose type has its bounds and unit, and whose metadata are its meaning and other rules."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

Conflict = tuple[str, str]
"""Key of the wrong setting, and its allowed values."""
PATH_RULE = "a path in a file of settings is relative to that file"
"""For messages about what is missing."""
INT32_MAX = 2**31 - 1
"""Largest whole number of kernels and largest index of their arrays: the upper limit of settings that become one of them."""


@dataclass(frozen=True)
class Within:
    """Bounds, inclusive, and unit of a setting's numbers, of each one in a tuple: `Annotated[float, Within(0.0, 1.0, "m")]`."""

    low: float | None = None
    high: float | None = None
    unit: str = ""
    above: float | None = None
    """Exclusive lower bound, in place of `low`."""


def above(least: float, high: float | None = None, unit: str = "") -> Within:
    """Bounds of which the lower one is exclusive."""
    return Within(None, high, unit, least)


Fraction = Annotated[float, Within(0.0, 1.0)]
Color = Annotated[tuple[float, float, float], Within(0.0, 1.0, "sRGB")]


@dataclass(frozen=True)
class Setting:
    """A setting: type of its values other than None, default, bounds and unit, and what `setting` was called with."""

    kind: Any
    default: Any
    bounds: Within
    doc: str
    choices: tuple[str, ...]
    parse: Callable[[Any], Any] | None
    allowed: str
    path: bool

    @property
    def unit(self) -> str:
        """Unit of the values; empty for dimensionless settings."""
        return self.bounds.unit


def setting(
    default: Any,
    doc: str,
    *,
    choices: tuple[str, ...] = (),
    parse: Callable[[Any], Any] | None = None,
    allowed: str = "",
    path: bool = False,
) -> Any:
    """Declare a setting: a field of a dataclass.

    Args:
        doc: Meaning, in sentences.
        choices: Allowed strings; empty: any.
        parse: Converts a value as TOML has it to one of the field's type; raises ValueError with what is allowed.
        allowed: What is allowed, where type, range and choices do not say it.
        path: Whether it names a file or folder; in a file of settings it is then relative to that file, else to the current folder.
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "choices": choices, "parse": parse, "allowed": allowed, "path": path})


@functools.cache
def settings_of(kind: type[Any]) -> dict[str, Setting]:
    """Settings of a section or of a row by name, in order; fields that `setting` did not declare are left out."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {item.name: _read(hints[item.name], item) for item in dataclasses.fields(kind) if item.metadata}


def _read(annotation: Any, item: dataclasses.Field[Any]) -> Setting:
    """Setting of a field."""
    bounds = Within()
    if typing.get_origin(annotation) is Annotated:
        annotation, bounds = typing.get_args(annotation)
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        annotation = next(part for part in typing.get_args(annotation) if part is not type(None))
    return Setting(annotation, item.default, bounds, **item.metadata)
