"""Validation of single settings: type, length, range, choices."""

import dataclasses
import operator
import re
import sys
import typing
from collections.abc import Iterator
from typing import Any

from synpick_warp.configs.episodes.randomize import OFF, Distribution
from synpick_warp.configs.fields import Setting
from synpick_warp.errors import ConfigError, format_value, suggest

_NAMES = {
    float: ("a finite number", "numbers"),
    int: ("a whole number", "whole numbers"),
    bool: ("true or false", "true or false"),
    str: ("a string", "strings"),
}
_SURROGATE = re.compile("[\ud800-\udfff]")
"""What UTF-8 lacks: bytes of the command line that are not UTF-8."""
_BOUNDS = (("above", "above"), ("low", "at least"), ("high", "at most"))


class _MismatchError(Exception):
    """The value is not of the setting's type; the message, if any, says what is allowed."""


def to_index(value: object) -> int | None:
    """Convert an integer, including NumPy's types, to int; None for booleans and all other types."""
    if isinstance(value, bool):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def check_value(key: str, value: object, item: Setting, source: str) -> Any:
    """Validate a value; returns it in the type of its setting, for instance a list as a tuple. `key`: full key of the setting, for
    messages. `value`: the value as parsed from TOML. `source`: where the value comes from, for messages, such as "in my.toml". Raises
    ConfigError: the value has the wrong type or length, is not finite, or lies outside the setting's range."""
    hint = ""
    try:
        result = _convert(item.parse(value) if item.parse else value, item.kind)
    except (_MismatchError, ValueError) as mismatch:
        allowed = str(mismatch) or describe_type(item.kind)
    else:
        wrong = [leaf for leaf in _leaves(result) if not _inside(leaf, item)]
        is_off = isinstance(result, Distribution) and result.kind == OFF != getattr(item.default, "kind", OFF)
        if not wrong and not is_off:
            return result
        allowed, hint = describe_allowed(item), "" if is_off else suggest(str(wrong[0]), item.choices)
    unit = f" [{item.unit}]" if item.unit else ""
    raise ConfigError(f"{key} is {format_value(value)} {source}; allowed: {allowed}{unit}{hint}")


def describe_allowed(item: Setting) -> str:
    """Describe the range or the choices of a setting, or its type if it has neither."""
    if item.allowed:
        return item.allowed
    is_list = typing.get_origin(item.kind) is tuple
    if item.choices:
        return "any of " * is_list + ", ".join(choice or '""' for choice in item.choices)
    if item.path:
        return "a path, in a file relative to it"
    words = [f"{word} {_number(bound)}" for name, word in _BOUNDS if (bound := getattr(item.bounds, name)) is not None]
    if _is_distribution(item.kind):
        off = f'"{OFF}", ' if getattr(item.default, "kind", "") == OFF else ""
        return f"{off}{item.kind.noun} or distribution, {', '.join(words)}"
    return "each " * is_list + ", ".join(words) if words else describe_type(item.kind)


def describe_type(annotation: Any, *, plural: bool = False) -> str:
    """Describe a type: "a finite number", "2 whole numbers in a list", "a list of lists of 3 numbers"."""
    if _is_distribution(annotation):
        return annotation.describe()
    if is_table(annotation):
        return f"a table of {', '.join(part.name for part in dataclasses.fields(annotation))}"
    if typing.get_origin(annotation) is not tuple:
        return _NAMES[annotation][plural]
    parts = typing.get_args(annotation)
    if parts[-1] is Ellipsis:
        return f"a list of {describe_type(parts[0], plural=True)}"
    if plural:
        return f"lists of {len(parts)} {describe_type(parts[0], plural=True)}"
    return f"{len(parts)} {describe_type(parts[0], plural=True)} in a list"


def _convert(value: object, annotation: Any) -> Any:
    """Value as the annotated type (int becomes float, lists tuples); raises _MismatchError if it does not fit."""
    if typing.get_origin(annotation) is tuple:
        parts = typing.get_args(annotation)
        if not isinstance(value, list | tuple) or (parts[-1] is not Ellipsis and len(value) != len(parts)):
            raise _MismatchError
        return tuple(map(_convert, value, parts if parts[-1] is not Ellipsis else parts[:1] * len(value)))
    if _is_distribution(annotation):
        try:
            return annotation.parse(value)
        except ValueError as error:
            raise _MismatchError(str(error)) from None
    if annotation is float:
        # Whole numbers may exceed a float's range, and TOML has inf and nan.
        if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= sys.float_info.max:
            raise _MismatchError
        return float(value)
    if type(value) is not annotation or (isinstance(value, str) and _SURROGATE.search(value)):
        raise _MismatchError
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise _MismatchError("a whole number of at most 64 bits, as TOML has")
    return value


def is_table(annotation: Any) -> bool:
    """Whether a setting of this type is a table in TOML."""
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation) and not _is_distribution(annotation)


def _is_distribution(annotation: Any) -> bool:
    """Whether a type is that of a distribution."""
    return isinstance(annotation, type) and issubclass(annotation, Distribution)


def _leaves(value: Any) -> Iterator[Any]:
    """Yield the single values of nested tuples, and of a distribution those that must lie within the setting's range."""
    if isinstance(value, Distribution):
        yield from value.limits()
    elif isinstance(value, tuple):
        for one in value:
            yield from _leaves(one)
    else:
        yield value


def _inside(leaf: Any, item: Setting) -> bool:
    """Whether a value is one of the choices, or within the bounds, of its setting."""
    if item.choices and not item.path:
        return leaf in item.choices
    if isinstance(leaf, str | bool):
        return True
    low, high, above = item.bounds.low, item.bounds.high, item.bounds.above
    return (low is None or leaf >= low) and (high is None or leaf <= high) and (above is None or leaf > above)


def _number(value: float) -> str:
    """Number as short text."""
    return str(value) if isinstance(value, int) else f"{value:g}"
