"""Parser of TOML tables in the settings: arrays of tables, such as [[camera]], whose rows are dataclasses, and [splits.NAME].

`Config` has a field for each list: `camera: tuple[CameraRow, ...] = ()`. The class of a row may name keys that every table needs
(`REQUIRED`), keys of no effect beside others (`replaced`), and keys by which a row is told from others (`IDENTITY`); a list with these can
be changed as a whole by a single table, [object_rows]. A setting may be a table itself, as `pose = {position = ...}`: its class is then
the setting's type.
"""

import dataclasses
import itertools
import re
from collections.abc import Mapping
from typing import Any

from synpick_warp.configs.check import check_value, is_table
from synpick_warp.configs.episodes.randomize import Distribution
from synpick_warp.configs.fields import INT32_MAX, settings_of
from synpick_warp.configs.schema import Split
from synpick_warp.errors import ConfigError, format_value, shorten, suggest


def read_rows(key: str, kind: type[Any], content: Any, source: str) -> tuple[Any, ...]:
    """Parse the array of tables [[key]]. Raises ConfigError if it is not one, a key is unknown or missing, or a value is not allowed."""
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise ConfigError(f"{key} is {format_value(content)} {source}; allowed: [[{key}]] tables")
    return tuple(read_table(f"{key}[{index}]", kind, row, source) for index, row in enumerate(content))


def read_table(key: str, kind: type[Any], content: object, source: str) -> Any:
    """Parse one table. Raises ConfigError if it is something else, a key is unknown or missing, or a value is not allowed."""
    known, required = settings_of(kind), getattr(kind, "REQUIRED", ())
    if not isinstance(content, Mapping):
        raise ConfigError(f"{key} is {format_value(content)} {source}; allowed: a table of {', '.join(known)}")
    for name in content:
        if name not in known:
            raise ConfigError(f"there is no key {key}.{shorten(name)}, set {source}; keys: {', '.join(known)}{suggest(name, list(known))}")
    for name in required:
        if name not in content:
            raise ConfigError(f"{key} has no {name} {source}; a row needs {' and '.join(required)}")
    values = {}
    for name, value in content.items():
        inner, item = f"{key}.{name}", known[name]
        values[name] = read_table(inner, item.kind, value, source) if is_table(item.kind) else check_value(inner, value, item, source)
    return kind(**values)


def change_rows(key: str, kind: type[Any], rows: tuple[Any, ...], changes: Mapping[str, Any], source: str) -> tuple[Any, ...]:
    """Override values of all rows of a preset by a table [key]. Raises ConfigError if a key or value is not allowed for all."""
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
    """Convert a row to a dictionary, without settings that are None or have no effect; nested tables become dictionaries."""
    values = ((name, getattr(row, name)) for name in settings_of(type(row)) if name not in getattr(row, "replaced", ()))
    return {name: _plain(value) for name, value in values if value is not None}


def _plain(value: Any) -> Any:
    if is_table(type(value)):
        return given_values(value)
    return value.to_toml() if isinstance(value, Distribution) else value


SPLITS = "splits"
MAX_SPLITS = 64
"""Maximum number of splits of a data set."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
_NEXT = -1
"""Value of `Split.first` of a split that continues after the previous one."""

Tables = dict[str, dict[str, Any]]
"""Name of a split -> its checked settings."""


def read_tables(content: Any, source: str) -> Tables:
    """Validate the table of tables `splits`; returns the values of each split. Raises ConfigError if it is not one, a name or a key is
    wrong, or a value is not allowed."""
    if not isinstance(content, Mapping) or not content or not all(isinstance(table, Mapping) for table in content.values()):
        raise ConfigError(f"{SPLITS} is {format_value(content)} {source}; allowed: tables such as [{SPLITS}.train]")
    if len(content) > MAX_SPLITS:
        raise ConfigError(f"{SPLITS} has {len(content)} tables {source}; allowed: up to {MAX_SPLITS}")
    for name in content:
        if not _NAME.fullmatch(name):
            raise ConfigError(f"the split {shorten(name)} {source} has no name of up to 32 letters, digits and underscores")
    return {name: {key: check_setting(name, key, value, source) for key, value in table.items()} for name, table in content.items()}


def check_setting(name: str, key: str, value: Any, source: str) -> Any:
    """Validate one setting of a split; returns its value. Raises ConfigError if the setting does not exist or the value is not allowed."""
    known = settings_of(Split)
    if key not in known:
        keys = f"keys of {SPLITS}.{name}: {', '.join(known)}"
        raise ConfigError(f"there is no key {SPLITS}.{name}.{shorten(key)}, set {source}; {keys}{suggest(key, list(known))}")
    return check_value(f"{SPLITS}.{name}.{key}", value, known[key], source)


def override_table(tables: Tables, path: str, value: Any, source: str) -> Tables:
    """Add a setting, NAME.key, to the tables. Raises ConfigError if there is no such split or setting, or the value is not allowed."""
    name, _, key = path.partition(".")
    if name not in tables:
        known = f"splits: {', '.join(tables)}" if tables else "the settings have none"
        raise ConfigError(f"there is no split {shorten(name)}, set {source}; {known}{suggest(name, list(tables))}")
    return tables | {name: tables[name] | {key: check_setting(name, key, value, source)}}


def resolve_splits(tables: Tables, mode: str, color_format: str, source: str) -> tuple[Split, ...]:
    """Convert validated tables to splits: defaults follow from the order in the file; the result is sorted by first episode. Raises
    ConfigError if two splits share an episode or a folder, or indices exceed 32 bits."""
    splits: list[Split] = []
    following = 0
    for name, table in tables.items():
        split = Split(name, **table)
        first = following if split.first == _NEXT else split.first
        following = first + split.episodes
        if following > INT32_MAX:
            raise ConfigError(f"{SPLITS}.{name} ends with episode {following - 1} {source}; allowed: less than {INT32_MAX}")
        suffix = "_pbr" if color_format == "jpg" and not name.endswith("_pbr") else ""
        splits.append(Split(name, split.episodes, first, split.mode or mode, split.folder or f"{name}{suffix}"))
    splits.sort(key=lambda split: split.first)
    for before, after in itertools.pairwise(splits):
        if after.first < before.first + before.episodes:
            rule = f"at least {before.first + before.episodes}, after the episodes of {before.name}"
            raise ConfigError(f"{SPLITS}.{after.name}.first is {after.first} {source}; allowed: {rule}")
    # Shards go beside each folder, with _web at the end.
    owners: dict[str, str] = {}
    for split in splits:
        for folder in (split.folder, f"{split.folder}_web"):
            if owners.setdefault(folder, split.name) != split.name:
                raise ConfigError(f"{SPLITS}.{split.name} would write to {folder}/ {source}, as would {owners[folder]}; set another folder")
    return tuple(splits)
