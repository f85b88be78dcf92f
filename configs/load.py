"""Reads settings: command line over file over preset."""

from __future__ import annotations

import dataclasses
import functools
import tomllib
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from synpick_warp.configs.check import checked, did_you_mean, shown
from synpick_warp.configs.consistency import complaints
from synpick_warp.configs.schema import Config, ObjectRow
from synpick_warp.errors import ConfigError

DEFAULT_PRESET = "synpick"
COMMAND_LINE = "on the command line"
ROWS = "object_rows"
_BASE = "preset"
_ROW_NEEDS = ("id", "diameter")

Values = dict[str, tuple[Any, str]]
"""Full key -> (checked value, where it stands)."""


def load_config(name_or_path: str | None, overrides: Mapping[str, object]) -> Config:
    """Read a preset or a file, and put `overrides` on top.

    Args:
        name_or_path: Name of a preset; or path of a file, which ends in .toml and may say `preset = "NAME"`, on which it then
            builds; None: the preset `synpick`. A file that names no preset builds on `synpick`, too.
        overrides: Full key, such as "physics.step", -> value as TOML has it.

    Raises:
        ConfigError: No such preset or file, a file that is no TOML, an unknown key, a value that is not allowed, or
            values that do not fit each other.
    """
    values = _read(name_or_path or DEFAULT_PRESET)
    for key, value in overrides.items():
        section, _, name = key.partition(".")
        values |= _section_values(section, {name: value}, COMMAND_LINE)
    config = _build(values)
    for key, rule in complaints(config):
        value, source = values.get(key, (_value_of(config, key), "by default"))
        came = f"has {len(value)} rows" if key == ROWS else f"is {shown(value)}"
        raise ConfigError(f"{key} {came} {source}; allowed: {rule}")
    return config


def preset_names() -> list[str]:
    """Names of the presets that the package brings."""
    return sorted(path.stem for path in _folder().glob("*.toml"))


def parse_assignment(text: str) -> tuple[str, object]:
    """Split "section.key=value" into key and value; the value is TOML, and for strings and lists of strings the quotes may be left out.

    Raises:
        ConfigError: There is no "=", or no such setting.
    """
    key, equals, written = text.partition("=")
    key = key.strip()
    if not equals:
        raise ConfigError(f"--set {text} has no value; write --set section.key=value, as in --set physics.friction=0.4")
    section, _, name = key.partition(".")
    _, kind = _setting(section, name, COMMAND_LINE)
    try:
        value: object = tomllib.loads(f"value = {written}")["value"]
    except tomllib.TOMLDecodeError:
        # A shell takes the quotes out of ["a","b"].
        words = written.strip().removeprefix("[").removesuffix("]").split(",")
        value = [word.strip() for word in words] if kind == tuple[str, ...] else written
    return key, written if kind is str and not isinstance(value, str) else value


def sections() -> dict[str, type[Any]]:
    """Name -> dataclass of every section, in order."""
    hints = typing.get_type_hints(Config)
    return {item.name: hints[item.name] for item in dataclasses.fields(Config) if item.name != ROWS}


@functools.cache
def settings_of(kind: type[Any]) -> dict[str, tuple[dataclasses.Field[Any], Any]]:
    """Name -> (field, resolved type) of every setting of a section or of an object row, in order."""
    hints = typing.get_type_hints(kind)
    return {item.name: (item, hints[item.name]) for item in dataclasses.fields(kind)}


def _folder() -> Path:
    return Path(__file__).parent


def _read(name_or_path: str) -> Values:
    if name_or_path.endswith(".toml"):
        document = _parse(Path(name_or_path))
        base = document.pop(_BASE, DEFAULT_PRESET)
        if not isinstance(base, str):
            raise ConfigError(f"{_BASE} is {shown(base)} in {name_or_path}; allowed: {', '.join(preset_names())}")
        return _read_preset(base, f" in {name_or_path}") | _document_values(document, f"in {name_or_path}")
    return _read_preset(name_or_path, "")


def _read_preset(name: str, source: str) -> Values:
    if name not in preset_names():
        names = preset_names()
        raise ConfigError(
            f"there is no preset {shown(name)}{source}; presets: {', '.join(names)}; a file's name ends in .toml{did_you_mean(name, names)}"
        )
    document = _parse(_folder() / f"{name}.toml")
    base = document.pop(_BASE, None)
    return (_read_preset(base, "") if base else {}) | _document_values(document, f"in the preset {name}")


def _parse(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_bytes().decode())
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {str(error)[:1].lower()}{str(error)[1:]}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: byte {error.start} is no UTF-8") from None
    except FileNotFoundError:
        raise ConfigError(f"there is no file {path}; give a .toml file or a preset: {', '.join(preset_names())}") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from None


def _document_values(document: Mapping[str, Any], source: str) -> Values:
    values: Values = {}
    for name, content in document.items():
        if name == ROWS:
            values[ROWS] = (_rows(content, source), source)
        elif name in sections() and not isinstance(content, dict):
            raise ConfigError(f"{name} is {shown(content)} {source}; allowed: a section, [{name}]")
        else:
            values |= _section_values(name, content if isinstance(content, dict) else {}, source)
    return values


def _section_values(section: str, content: Mapping[str, Any], source: str) -> Values:
    _known_section(section, source)
    values: Values = {}
    for name, value in content.items():
        key = f"{section}.{name}"
        item, kind = _setting(section, name, source)
        values[key] = (checked(key, value, item, kind, source), source)
    return values


def _known_section(section: str, source: str) -> None:
    known = sections()
    if section == ROWS:
        raise ConfigError(f"{ROWS} cannot be set {source}; write [[{ROWS}]] tables into a file")
    if section not in known:
        # A setting's own name, without its section, is a surer sign than a section of a similar name.
        homes = [f"{home}.{section}" for home, kind in known.items() if section in settings_of(kind)]
        hint = f"; did you mean {' or '.join(homes)}?" if homes else did_you_mean(section, list(known))
        raise ConfigError(f"there is no section {section}, set {source}; sections: {', '.join(known)}, {ROWS}{hint}")


def _setting(section: str, name: str, source: str) -> tuple[dataclasses.Field[Any], Any]:
    _known_section(section, source)
    known = settings_of(sections()[section])
    if name not in known:
        hint = did_you_mean(name, list(known))
        homes = [f"{home}.{name}" for home, kind in sections().items() if name in settings_of(kind)]
        if homes and not hint:
            hint = f"; did you mean {' or '.join(homes)}?"
        raise ConfigError(f"there is no key {section}.{name}, set {source}; keys of {section}: {', '.join(known)}{hint}")
    return known[name]


def _rows(content: Any, source: str) -> tuple[ObjectRow, ...]:
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise ConfigError(f"{ROWS} is {shown(content)} {source}; allowed: [[{ROWS}]] tables")
    return tuple(_row(f"{ROWS}[{number}]", row, source) for number, row in enumerate(content))


def _row(key: str, content: Mapping[str, Any], source: str) -> ObjectRow:
    known = settings_of(ObjectRow)
    for name in content:
        if name not in known:
            raise ConfigError(f"there is no key {key}.{name}, set {source}; keys: {', '.join(known)}{did_you_mean(name, list(known))}")
    for name in _ROW_NEEDS:
        if name not in content:
            raise ConfigError(f"{key} has no {name} {source}; a row needs {' and '.join(_ROW_NEEDS)}")
    return ObjectRow(**{name: checked(f"{key}.{name}", value, *known[name], source) for name, value in content.items()})


def _build(values: Values) -> Config:
    parts: dict[str, Any] = {
        section: kind(**{name: values[f"{section}.{name}"][0] for name in settings_of(kind) if f"{section}.{name}" in values})
        for section, kind in sections().items()
    }
    if ROWS in values:
        parts[ROWS] = values[ROWS][0]
    return Config(**parts)


def _value_of(config: Config, key: str) -> Any:
    return functools.reduce(getattr, key.split("."), config)
