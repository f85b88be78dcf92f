"""Exceptions for errors that a user can correct, and the text of values in their messages.

The command line prints such a message as one line and exits with code 2.
"""

import difflib
import json
from collections.abc import Sequence

_SHOWN = 60
"""Length to which values are truncated in messages."""


class SynpickError(Exception):
    """Base class; the message says in one line what was given, what is allowed and what to do."""


class ConfigError(SynpickError):
    """A setting is unknown, of the wrong type, out of range, or inconsistent with others."""


class CatalogError(SynpickError):
    """A model folder or one of its files cannot be used."""


class LightError(SynpickError):
    """A light map cannot be used."""


class DeviceError(SynpickError):
    """The requested device does not exist."""


class OutputError(SynpickError):
    """The output folder cannot be written."""


class StoreError(OutputError):
    """An object store cannot be used, or does not answer."""


class DatasetError(SynpickError):
    """A folder is not a data set, or a file in it is missing or damaged."""


class StateError(SynpickError):
    """A state of worlds does not fit the simulation, or cannot be taken."""


class ActionError(SynpickError):
    """Actions for an environment cannot be carried out."""


class ResultError(SynpickError):
    """A file of pose estimates cannot be used."""


def format_value(value: object) -> str:
    """Format a value as TOML writes it, truncated, on one line."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError, RecursionError):
        text = _describe(value)
    return shorten(text)


def shorten(text: str) -> str:
    """Truncate a text for a message, and escape what does not print."""
    return escape(text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…")


def escape(text: str) -> str:
    """Escape what does not print, such as line breaks and terminal sequences."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def suggest(word: str, known: Sequence[str]) -> str:
    """Suggest the most similar known word, as the end of a message; empty if none is similar."""
    near = difflib.get_close_matches(word[:_SHOWN], known, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _describe(value: object) -> str:
    """Describe a value that JSON lacks: a date, a circle, or a number with more digits than Python prints."""
    try:
        return str(value)
    except (ValueError, RecursionError):
        return "a number of thousands of digits" if isinstance(value, int) else f"a {type(value).__name__}"
