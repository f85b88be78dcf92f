"""Checks one value against its setting: type, length, range, choices."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import typing
from collections.abc import Iterator, Sequence
from typing import Any

from synpick_warp.errors import ConfigError

_NAMES = {
    float: ("a finite number", "numbers"),
    int: ("a whole number", "whole numbers"),
    bool: ("true or false", "true or false"),
    str: ("a string", "strings"),
}
_BOUNDS = (("above", "above"), ("low", "at least"), ("high", "at most"))
_SHOWN = 60
"""Longer values are cut in messages."""


class _MismatchError(Exception):
    """The value is not of the setting's type."""


def checked(key: str, value: object, item: dataclasses.Field[Any], kind: Any, source: str) -> Any:
    """Return `value` as the type `kind` of the setting `item`, for instance a list as a tuple.

    Args:
        key: Full name of the setting, for the message.
        value: As TOML has it.
        item: Field made by `schema.setting`.
        kind: The field's resolved annotation.
        source: Where the value stands, such as "in my.toml".

    Raises:
        ConfigError: The value has the wrong type or length, is not finite, or lies outside the setting's range.
    """
    try:
        result = _converted(value, kind)
    except _MismatchError:
        raise ConfigError(f"{key} is {shown(value)} {source}; allowed: {describe_kind(kind)}{_unit(item)}") from None
    if not all(_inside(leaf, item) for leaf in _leaves(result)):
        wrong = next(leaf for leaf in _leaves(result) if not _inside(leaf, item))
        hint = did_you_mean(str(wrong), item.metadata["choices"])
        raise ConfigError(f"{key} is {shown(value)} {source}; allowed: {allowed(item, kind)}{_unit(item)}{hint}")
    return result


def allowed(item: dataclasses.Field[Any], kind: Any) -> str:
    """The range or the choices of a setting in words, or its type if every value of the type will do."""
    rules = item.metadata
    if rules["choices"]:
        return ("any of " if typing.get_origin(kind) is tuple else "") + ", ".join(rules["choices"])
    words = [f"{word} {_number(rules[name])}" for name, word in _BOUNDS if rules[name] is not None]
    if not words:
        return describe_kind(kind)
    return ("each " if typing.get_origin(kind) is tuple else "") + ", ".join(words)


def describe_kind(kind: Any, *, plural: bool = False) -> str:
    """A type in words: "a number", "2 whole numbers", "a list of triples"."""
    if typing.get_origin(kind) is not tuple:
        return _NAMES[kind][plural]
    parts = typing.get_args(kind)
    if parts[-1] is Ellipsis:
        return f"a list of {describe_kind(parts[0], plural=True)}"
    if plural:
        return f"lists of {len(parts)} {describe_kind(parts[0], plural=True)}"
    return f"{len(parts)} {describe_kind(parts[0], plural=True)} in a list"


def shown(value: object) -> str:
    """A value as TOML writes it, cut if long, always on one line."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):
        text = str(value).replace("\n", " ")
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """A suggestion to append to a message, or nothing."""
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _converted(value: object, kind: Any) -> Any:
    if typing.get_origin(kind) is tuple:
        return _converted_tuple(value, typing.get_args(kind))
    if kind is float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise _MismatchError
        return _finite(value)
    if type(value) is not kind or (kind is str and not _encodable(str(value))):
        raise _MismatchError
    return value


def _converted_tuple(value: object, parts: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise _MismatchError
    if parts[-1] is Ellipsis:
        return tuple(_converted(one, parts[0]) for one in value)
    if len(value) != len(parts):
        raise _MismatchError
    return tuple(_converted(one, part) for one, part in zip(value, parts, strict=True))


def _finite(value: float) -> float:
    """As a float; a whole number may exceed a float's range, and TOML knows inf and nan."""
    try:
        result = float(value)
    except OverflowError:
        raise _MismatchError from None
    if not math.isfinite(result):
        raise _MismatchError
    return result


def _encodable(text: str) -> bool:
    """Whether the text can be stored: arguments whose bytes are no UTF-8 cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, tuple):
        for one in value:
            yield from _leaves(one)
    else:
        yield value


def _inside(leaf: Any, item: dataclasses.Field[Any]) -> bool:
    rules = item.metadata
    if rules["choices"]:
        return leaf in rules["choices"]
    if isinstance(leaf, str | bool):
        return True
    return (
        (rules["low"] is None or leaf >= rules["low"])
        and (rules["high"] is None or leaf <= rules["high"])
        and (rules["above"] is None or leaf > rules["above"])
    )


def _unit(item: dataclasses.Field[Any]) -> str:
    return f" [{item.metadata['unit']}]" if item.metadata["unit"] else ""


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"
