"""Lists of tables in the settings, such as [[camera]]: each table is a row, a dataclass of settings.

`Config` has a field for each list: `camera: tuple[CameraRow, ...] = ()`. The class of a row may name keys that every table needs
(`REQUIRED`), keys of no effect beside others (`replaced`), and keys by which a row is told from others (`IDENTITY`); a list with these can
be changed as a whole by a single table, [object_rows]. A setting may be a table itself, as `pose = {position = ...}`: its class is then
the setting's type.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from synpick_warp.configs.check import check_value, is_table
from synpick_warp.configs.episodes.randomize import Distribution
from synpick_warp.configs.fields import Setting, settings_of
from synpick_warp.errors import ConfigError, format_value, shorten, suggest


def read_rows(key: str, kind: type[Any], content: Any, source: str) -> tuple[Any, ...]:
    """Rows of the tables [[key]].

    Raises:
        ConfigError: It is no list of tables, a key is unknown or missing, or a value is not allowed.
    """
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise ConfigError(f"{key} is {format_value(content)} {source}; allowed: [[{key}]] tables")
    return tuple(read_table(f"{key}[{index}]", kind, row, source) for index, row in enumerate(content))


def read_table(key: str, kind: type[Any], content: object, source: str) -> Any:
    """One row, or a setting that is a table.

    Raises:
        ConfigError: It is no table, a key is unknown or missing, or a value is not allowed.
    """
    known, required = settings_of(kind), getattr(kind, "REQUIRED", ())
    if not isinstance(content, Mapping):
        raise ConfigError(f"{key} is {format_value(content)} {source}; allowed: a table of {', '.join(known)}")
    for name in content:
        if name not in known:
            raise ConfigError(f"there is no key {key}.{shorten(name)}, set {source}; keys: {', '.join(known)}{suggest(name, list(known))}")
    for name in required:
        if name not in content:
            raise ConfigError(f"{key} has no {name} {source}; a row needs {' and '.join(required)}")
    return kind(**{name: _read_setting(f"{key}.{name}", value, known[name], source) for name, value in content.items()})


def _read_setting(key: str, value: object, item: Setting, source: str) -> Any:
    """Checked value of a setting, which may be a table."""
    return read_table(key, item.kind, value, source) if is_table(item.kind) else check_value(key, value, item, source)


def change_rows(key: str, kind: type[Any], rows: tuple[Any, ...], changes: Mapping[str, Any], source: str) -> tuple[Any, ...]:
    """Rows of a preset with the values of a table [key], which hold for all of them.

    Raises:
        ConfigError: A key is not one of those that may hold for every row, or a value is not allowed.
    """
    identity = getattr(kind, "IDENTITY", ())
    if not identity:
        raise ConfigError(f"{key} is a table {source}; allowed: [[{key}]] tables, one for each")
    known = {name: item for name, item in settings_of(kind).items() if name not in identity}
    for name in changes:
        if name not in known:
            rule = f"keys that may hold for every row: {', '.join(known)}; [[{key}]] tables have all"
            raise ConfigError(f"[{key}] has the key {shorten(name)} {source}; {rule}{suggest(name, list(known))}")
    values = {name: check_value(f"{key}.{name}", value, known[name], source) for name, value in changes.items()}
    return tuple(dataclasses.replace(row, **values) for row in rows)


def given_values(row: Any) -> dict[str, Any]:
    """Convert a row to a dictionary of the settings that are given (not None) and of effect; nested tables become dictionaries."""
    values = ((name, getattr(row, name)) for name in settings_of(type(row)) if name not in getattr(row, "replaced", ()))
    return {name: _plain(value) for name, value in values if value is not None}


def _plain(value: Any) -> Any:
    if is_table(type(value)):
        return given_values(value)
    return value.to_toml() if isinstance(value, Distribution) else value
