"""Declaration of a setting: a dataclass field whose type has its bounds and unit, and whose metadata are its meaning and other rules."""

import ast
import dataclasses
import functools
import re
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
class Bounds:
    """Bounds and unit of a setting's numbers, of each one in a tuple."""

    low: float | None = None
    """Inclusive lower bound."""
    above: float | None = None
    """Exclusive lower bound, in place of `low`."""
    high: float | None = None
    """Inclusive upper bound."""
    unit: str = ""

    @classmethod
    def parse(cls, text: str) -> "Bounds":
        """Bounds of an interval, as in `Annotated[float, "(0, 10] m"]`: both, one or none of interval and unit; "inf" is no bound."""
        bracket, low, high, unit = _INTERVAL.fullmatch(text).groups()  # type: ignore[union-attr]
        least, most = (None if bound in (None, "inf") else ast.literal_eval(bound) for bound in (low, high))
        return cls(least if bracket == "[" else None, least if bracket == "(" else None, most, unit)


_INTERVAL = re.compile(r"(?:([\[(])(\S+), (\S+)[\])])? ?(.*)")
Fraction = Annotated[float, "[0, 1]"]
Color = Annotated[tuple[float, float, float], "[0, 1] sRGB"]


@dataclass(frozen=True)
class Setting:
    """A setting: type of its values other than None, default, bounds and unit, and what `setting` was called with."""

    kind: Any
    default: Any
    bounds: Bounds
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
    """Declare a setting: a field of a dataclass. `doc`: meaning, in sentences. `choices`: allowed strings; empty: any. `parse`: converts a
    value as TOML has it to one of the field's type; raises ValueError with what is allowed. `allowed`: what is allowed, where type, range
    and choices do not say it. `path`: whether it names a file or folder, or something else by one of `choices`; in a file of settings
    it is then relative to that file, else to the current folder."""
    return dataclasses.field(default=default, metadata={"doc": doc, "choices": choices, "parse": parse, "allowed": allowed, "path": path})


@functools.cache
def settings_of(kind: type[Any]) -> dict[str, Setting]:
    """Settings of a section or of a row by name, in order; fields that `setting` did not declare are left out."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {item.name: _read(hints[item.name], item) for item in dataclasses.fields(kind) if item.metadata}


def _read(annotation: Any, item: dataclasses.Field[Any]) -> Setting:
    bounds = Bounds()
    if typing.get_origin(annotation) is Annotated:
        annotation, bounds = annotation.__origin__, Bounds.parse(annotation.__metadata__[0])
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        annotation = next(part for part in typing.get_args(annotation) if part is not type(None))
    return Setting(annotation, item.default, bounds, **item.metadata)
