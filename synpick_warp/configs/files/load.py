"""Configuration loading: presets and TOML files, overridden by single settings, checked and resolved to a `Config`; and its TOML."""

import dataclasses
import functools
import json
import os
import re
import typing
from collections.abc import Callable, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any

from synpick_warp.configs.calibration.tables import fill_tables, sensor_settings
from synpick_warp.configs.cell.bins import BinRow, check_meshes
from synpick_warp.configs.cell.cameras import Cameras
from synpick_warp.configs.cell.gripper import Gripper, follow_vacuum
from synpick_warp.configs.check import check_value, describe_allowed
from synpick_warp.configs.episodes.objects import MESH
from synpick_warp.configs.episodes.randomize import Distribution
from synpick_warp.configs.fields import Setting, settings_of
from synpick_warp.configs.files.table_lists import SPLITS, change_rows, given_values, override_table, read_rows, read_tables, resolve_splits
from synpick_warp.configs.rules.consistency import find_conflicts
from synpick_warp.configs.schema import Bake, Bop, Config, Split
from synpick_warp.errors import ConfigError, format_value, shorten, suggest
from synpick_warp.system.inputs.files import decode_toml, read_toml

DEFAULT_PRESET = "synpick"
COMMAND_LINE = "on the command line"
"""Source of settings that come as options, in error messages."""
CAMERA = "camera"
_BASE = "preset"
_PRESET = "in the preset"
"""Begin of the source of settings of a preset."""
_OF_SPLITS = ("bake.mode", "bake.episodes")
"""Settings from which splits are resolved."""

Values = dict[str, tuple[Any, str]]
"""Full key -> (checked value, its source for error messages)."""


def load_config(
    preset_or_file: Path | str | None = None,
    settings: Mapping[str, object] | None = None,
    *,
    source: str = "in the settings passed",
    splits: bool = False,
    measure: Callable[[tuple[BinRow, ...], Gripper], Mapping[str, Any]] | None = None,
) -> Config:
    """Load a preset or a TOML file, override single settings, and validate the result; see `synpick_warp.load_config`.

    Settings override the file, the file its preset (or "synpick"), the preset the defaults of the schema. Values may be lists for TOML's
    arrays, tuples or arrays. Paths are relative to the current folder; those in a file to that file. `source`: where `settings` come from,
    for error messages. `splits`: whether the splits of a preset hold, such as train and test of "synpick", unless a file sets mode or
    episodes otherwise; the [splits] of a file always hold. `measure`: tables and sections to replace, of bins and gripper, with what their
    meshes measure; None: without.

    Raises ConfigError: There is no such preset or file, the file is not valid TOML, a key is unknown, a value is not allowed, or values
    contradict each other. The message names key, value and source, and what is allowed."""
    if not isinstance(preset_or_file, str | os.PathLike | None):
        raise ConfigError(f"the preset passed is {format_value(preset_or_file)}; allowed: a name, or the path of a .toml file")
    values = _read(os.fspath(preset_or_file or DEFAULT_PRESET))
    if not splits and _is_preset(values.get(SPLITS, (None, ""))[1]):
        del values[SPLITS]
    if not isinstance(settings or {}, Mapping):
        raise ConfigError(f"the settings passed are {format_value(settings)}; allowed: a dict, of full keys such as bake.episodes")
    for key, value in (settings or {}).items():
        section, _, name = (key if isinstance(key, str) else format_value(key)).partition(".")
        if section == SPLITS:
            values[SPLITS] = (override_table(values.get(SPLITS, ({}, ""))[0], name, value, source), source)
        else:
            values |= _section_values(section, {name: value}, source)
    config = _follow(_build(values, source if settings else ""), values)
    _check_conflicts(config, values)
    if measure is not None and (found := measure(config.bin, config.gripper)):
        config = dataclasses.replace(config, **found)
        _check_conflicts(config, values)
    return config


def override_config(config: Config, settings: Mapping[str, object], source: str = "in the settings passed") -> Config:
    """Override single settings of a finished configuration, and validate the result. `settings`: full key, such as "physics.step", ->
    value; or list of tables or section, such as "bin", -> its rows or content. `source`: where `settings` come from, for error messages.
    Raises ConfigError: a key is unknown, a value is not allowed, values contradict each other, or a setting belongs to splits, which are
    resolved when a configuration is loaded."""
    values: Values = {}
    for key, value in settings.items():
        if key in table_lists() or dataclasses.is_dataclass(value):
            config = dataclasses.replace(config, **{key: value})
            continue
        section, _, name = key.partition(".")
        if section == SPLITS or (config.splits and key in _OF_SPLITS):
            raise ConfigError(f"{key} is set {source}, but the configuration has its splits already; pass it to load_config")
        values |= _section_values(section, {name: value}, source)
    config = _follow(config.with_values({key: value for key, (value, _) in values.items()}), values)
    _check_conflicts(config, values)
    return config


def _follow(config: Config, values: Values) -> Config:
    """Configuration whose suction follows from its vacuum, but for what is set beside it, other than in a preset."""
    fixed = {key.partition(".")[2] for key, (_, source) in values.items() if key.startswith("suction.") and not _is_preset(source)}
    return dataclasses.replace(config, suction=follow_vacuum(config.gripper, config.suction, fixed))


def _check_conflicts(config: Config, values: Values) -> None:
    """Raise a ConfigError for the first violated rule between settings; `values` has the sources of those that were set."""
    for key, rule in find_conflicts(config):
        owner = values.get(SPLITS if key.startswith(f"{SPLITS}.") else key.partition("[")[0], (None, "by default"))
        value, origin = _value_of(config, key), owner[1]
        has = f"has {len(value)} rows" if key in table_lists() else f"is {format_value(value)}"
        raise ConfigError(f"{key} {has} {origin}; allowed: {rule}")


def preset_names() -> list[str]:
    """Names of the presets in this package."""
    return sorted(path.stem for path in _folder().glob("*.toml"))


def describe_presets() -> dict[str, str]:
    """Meaning of each preset by name: the comment at the head of its file."""
    files = {name: (_folder() / f"{name}.toml").read_text().splitlines() for name in preset_names()}
    return {name: " ".join(line[2:] for line in takewhile(lambda line: line.startswith("# "), lines)) for name, lines in files.items()}


def parse_assignment(text: str) -> tuple[str, object]:
    """Parse "section.key=value" into key and value. The value is TOML; quotes of strings and in lists of strings may be omitted. Raises
    ConfigError: there is no "=", no such setting, or more than one setting."""
    key, equals, written = text.partition("=")
    key = key.strip()
    if not equals:
        raise ConfigError(f"--set {shorten(text)} has no value; write --set section.key=value, as in --set physics.friction=0.4")
    section, _, name = key.partition(".")
    found = settings_of(Split).get(name.rpartition(".")[2]) if section == SPLITS else _setting(section, name, COMMAND_LINE)
    kind = found.kind if found else str
    try:
        document = decode_toml(f"value = {written}")
    except ValueError:  # TOML's errors are ValueErrors.
        # A shell removes the quotes of ["a","b"].
        words = written.strip().removeprefix("[").removesuffix("]").split(",")
        return key, [word.strip() for word in words] if kind == tuple[str, ...] else written
    if len(document) > 1:
        raise ConfigError(f"--set {key} is followed by further lines; write one --set for each setting")
    value = document["value"]
    return key, written if kind is str and not isinstance(value, str) else value


@functools.cache
def sections() -> dict[str, type[Any]]:
    """Dataclass of every section by its name, in their order."""
    hints = typing.get_type_hints(Config)
    return {item.name: hints[item.name] for item in dataclasses.fields(Config) if dataclasses.is_dataclass(hints[item.name])}


@functools.cache
def table_lists() -> dict[str, type[Any]]:
    """Dataclass of the rows of every list of tables by its name, such as camera: [[camera]]."""
    hints = typing.get_type_hints(Config)
    lists = (item.name for item in dataclasses.fields(Config) if item.name not in (*sections(), SPLITS))
    return {name: typing.get_args(hints[name])[0] for name in lists}


def _folder() -> Path:
    """Folder of the presets."""
    return Path(__file__).parents[1] / "presets"


def _read(preset_or_file: str) -> Values:
    """Values of a preset or a .toml file over the preset it is based on, with the source of each."""
    if preset_or_file.endswith(".toml"):
        document = _parse(Path(preset_or_file))
        _locate(document, os.path.dirname(preset_or_file))
        check_meshes(document.get("bin"), f"in {preset_or_file}")
        if CAMERA in document:
            document[CAMERA] = fill_tables(document[CAMERA], f"in {preset_or_file}")
        base = document.pop(_BASE, DEFAULT_PRESET)
        if not isinstance(base, str):
            raise ConfigError(f"{_BASE} is {format_value(base)} in {preset_or_file}; allowed: {', '.join(preset_names())}")
        return _override(_read_preset(base, f" in {preset_or_file}"), document, f"in {preset_or_file}")
    return dict(_read_preset(preset_or_file, ""))


def _locate(document: dict[str, Any], folder: str) -> None:
    """Make the paths in a document absolute that are relative to its folder; whatever else is wrong with them is left as it is."""
    for name, kind in (sections() | table_lists()).items():
        paths = {key: item.choices for key, item in settings_of(kind).items() if item.path}
        content = document.get(name)
        for table in content if isinstance(content, list) else [content]:
            for key, names in paths.items():
                if isinstance(table, dict) and table.get(key) and isinstance(table[key], str) and table[key] not in names:
                    table[key] = os.path.abspath(os.path.join(folder, os.path.expanduser(table[key])))


def _is_preset(source: str) -> bool:
    """Whether a value comes from a preset, not from a file or the caller."""
    return source.startswith(_PRESET) and not source.endswith(".toml")


def _read_preset(name: str, source: str) -> Values:
    """Values of a preset over the one it is based on, with their sources; raises ConfigError if there is none of the name."""
    names = preset_names()
    if name not in names:
        known = f"presets: {', '.join(names)}; a file's name ends in .toml"
        raise ConfigError(f"there is no preset {format_value(name)}{source}; {known}{suggest(name, names)}")
    return _preset_values(name)


@functools.cache
def _preset_values(name: str) -> Values:
    """Values of a preset that is there, read once a process: presets come with the program."""
    document = _parse(_folder() / f"{name}.toml")
    base = document.pop(_BASE, None)
    return _override(_preset_values(base) if base else {}, document, f"{_PRESET} {name}")


def _parse(path: Path) -> dict[str, Any]:
    """Content of a .toml file; raises ConfigError."""
    if not os.path.lexists(path):
        raise ConfigError(f"there is no file {path}; give a .toml file or a preset: {', '.join(preset_names())}")
    return read_toml(path, ConfigError)


def _override(base: Values, document: Mapping[str, Any], source: str) -> Values:
    """Override the values of a preset by those of a document that builds on it; its mode or number of episodes undo the preset's splits."""
    values = dict(base)
    bake = document.get("bake")
    if isinstance(bake, dict) and ("mode" in bake or "episodes" in bake):
        values.pop(SPLITS, None)
    for name, content in document.items():
        if (kind := table_lists().get(name)) and isinstance(content, dict):
            values[name] = (change_rows(name, kind, base[name][0] if name in base else (), content, source), source)
        elif kind:
            values[name] = (read_rows(name, kind, content, source), source)
        elif name == SPLITS:
            values[SPLITS] = (read_tables(content, source), source)
        elif name in sections() and not isinstance(content, dict):
            raise ConfigError(f"{name} is {format_value(content)} {source}; allowed: a section, [{name}]")
        else:
            values |= _section_values(name, content if isinstance(content, dict) else {}, source)
    return values


def _section_values(section: str, content: Mapping[str, Any], source: str) -> Values:
    """Checked values of a section by key, with their source."""
    _check_section(section, source)
    values: Values = {}
    if section == "depth_sensor":
        content = sensor_settings(str(content.get("preset", ""))) | dict(content)
    for name, value in content.items():
        key = f"{section}.{name}"
        values[key] = (check_value(key, _plain(value), _setting(section, name, source), source), source)
    return values


def _plain(value: Any) -> Any:
    """A path as its name, and a number or an array of NumPy or PyTorch in Python's types; others as they are."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.tolist() if hasattr(value, "tolist") else value


def _check_section(section: str, source: str) -> None:
    """Raise ConfigError if there is no section of this name, with a hint."""
    known = sections()
    if section.partition("[")[0] in table_lists():
        name = section.partition("[")[0]
        raise ConfigError(f"{name} cannot be set {source}; write [[{name}]] tables into a file")
    if section not in known:
        # A setting without its section is likelier than a misspelt section.
        keys = [f"{name}.{section}" for name, kind in known.items() if section in settings_of(kind)]
        hint = f"; did you mean {' or '.join(keys)}?" if keys else suggest(section, list(known))
        raise ConfigError(
            f"there is no section {shorten(section)}, set {source}; sections: {', '.join((*known, *table_lists(), SPLITS))}{hint}"
        )


def _setting(section: str, name: str, source: str) -> Setting:
    """A setting; raises ConfigError if there is none of the name, with a hint."""
    _check_section(section, source)
    known = settings_of(sections()[section])
    if not name:
        raise ConfigError(f"{section} is a section, set {source}; set single keys, such as {section}.{next(iter(known))}")
    if name not in known:
        hint = suggest(name, list(known))
        keys = [f"{other}.{name}" for other, kind in sections().items() if name in settings_of(kind)]
        if keys and not hint:
            hint = f"; did you mean {' or '.join(keys)}?"
        raise ConfigError(f"there is no key {section}.{shorten(name)}, set {source}; keys of {section}: {', '.join(known)}{hint}")
    return known[name]


def _build(values: Values, override: str) -> Config:
    """Configuration of checked values; `override` is the source of single settings."""
    splits = ()
    if SPLITS in values:
        tables, source = values[SPLITS]
        mode, written = values.get("bake.mode", (Bake().mode, ""))
        splits = resolve_splits(tables, mode, values.get("bop.color_format", (Bop().color_format, ""))[0], source)
        total = sum(split.episodes for split in splits)
        asked, origin = values.get("bake.episodes", (total, ""))
        if asked != total and origin in (source, override):
            raise ConfigError(
                f"bake.episodes is {asked} {origin}; allowed: {total} or none, as each split sets its own: splits.NAME.episodes"
            )
        if written and written == override and all("mode" in table for table in tables.values()):
            raise ConfigError(f"bake.mode is {format_value(mode)} {written}; allowed: none, as each split sets its own: splits.NAME.mode")
        values = values | {"bake.episodes": (total, source)}
    elif "bake.episodes" not in values and (worlds := values.get("bake.worlds", (0, "")))[0]:
        values = values | {"bake.episodes": worlds}
    if "objects.density" in values:
        # A known density is that of the material; the default is a guess over the convex hull.
        values = {"objects.mass_volume": (MESH, values["objects.density"][1])} | values
    parts: dict[str, Any] = {
        section: kind(**{name: values[f"{section}.{name}"][0] for name in settings_of(kind) if f"{section}.{name}" in values})
        for section, kind in sections().items()
    }
    parts |= {name: values[name][0] for name in table_lists() if name in values}
    _check_sole_cameras(values, override)
    if parts.get(CAMERA):
        # As in config.toml: what else a preset sets of [cameras] is of no effect beside [[camera]] tables.
        parts[CAMERAS] = Cameras(resolution=parts[CAMERAS].resolution)
    return Config(**parts, splits=splits)


def _check_sole_cameras(values: Values, override: str) -> None:
    """Raise ConfigError if [cameras] and [[camera]] are set in one place, where one of both would be of no effect.

    A place that sets all of [cameras] is what `config_to_toml` wrote.
    """
    rows, source = values.get(CAMERA, ((), ""))
    if all(values.get(f"cameras.{name}", (None, ""))[1] == source for name in settings_of(Cameras)):
        return
    for key, (value, origin) in values.items():
        section, _, name = key.partition(".")
        # A written configuration has the resolution, which is that of rows without one.
        is_default = name == "resolution" and (origin != override or any(row.resolution is None for row in rows))
        if rows and section == "cameras" and origin in (source, override) and not is_default:
            raise ConfigError(
                f"{key} is {format_value(value)} {origin}; allowed: none, as the [[{CAMERA}]] tables have values of their own"
            )


def _value_of(config: Config, key: str) -> Any:
    """Value of a setting by its key, "section.name", "splits.split.name" or "list[index].name"."""
    if key.startswith(f"{SPLITS}."):
        _, name, item = key.split(".")
        return next(getattr(split, item) for split in config.splits if split.name == name)
    if "[" in key:
        rows, _, rest = key.partition("[")
        index, _, name = rest.partition("].")
        given: Any = given_values(getattr(config, rows)[int(index)])
        for part in name.split("."):
            given = given.get(part)
        return given
    return functools.reduce(getattr, key.split("."), config)


CAMERAS = "cameras"
_DELETE = "\x7f"
"""The only control character that JSON does not escape and TOML forbids."""


def config_to_toml(config: Config, *, comments: bool = False) -> str:
    """All settings as TOML text, including defaults; paths are absolute, so that it holds wherever it is written to. `comments`: each
    setting is preceded by its meaning, unit and allowed values."""
    # Without rows those of the preset would hold; no preset has rows of another kind.
    lines = [] if config.object_rows else ["object_rows = []", ""]
    for section, kind in sections().items():
        if comments and kind.__doc__:
            lines += [f"# {' '.join(kind.__doc__.split())}"]
        table = _table(getattr(config, section), kind, comments)
        if section == CAMERAS and config.camera:
            # The rest is of no effect beside [[camera]] tables, which are read only alone.
            table = [f"resolution = {format_toml(config.cameras.resolution)}"]
        lines += [f"[{section}]", *table, ""]
    for name, kind in table_lists().items():
        for index, row in enumerate(getattr(config, name)):
            lines += [f"[[{name}]]", *_table(row, kind, comments and index == 0), ""]
    for index, split in enumerate(config.splits):
        lines += [f"[{SPLITS}.{split.name}]", *_table(split, Split, comments and index == 0), ""]
    return "\n".join(lines)


def _table(values: Any, kind: type[Any], comments: bool) -> list[str]:
    """Lines of a TOML table; `comments`: each setting with meaning, unit and allowed values above it."""
    lines, given = [], given_values(values)
    for name, item in settings_of(kind).items():
        if name not in given:
            continue
        if comments:
            lines.append(f"# {describe_setting(item)}")
        value = os.path.abspath(given[name]) if item.path and given[name] and given[name] not in item.choices else given[name]
        lines.append(f"{name} = {format_toml(value)}")
    return lines


def describe_setting(item: Setting) -> str:
    """Meaning, unit and allowed values of a setting, in sentences."""
    unit = f"[{item.unit}] " if item.unit else ""
    meaning = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", item.doc)  # Links lead from configs/REFERENCE.md.
    return f"{meaning} {unit}Allowed: {describe_allowed(item)}."


def format_toml(value: Any) -> str:
    """Format a value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(_DELETE, "\\u007f")
    if isinstance(value, Distribution):
        return format_toml(value.to_toml())
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {format_toml(one)}' for key, one in value.items())} }}"
    if isinstance(value, tuple):
        return f"[{', '.join(format_toml(one) for one in value)}]"
    return repr(value)
