"""Configuration serialization to TOML: complete, and `load_config` reads the same configuration back."""

import json
import os
import re
from typing import Any

from synpick_warp.configs.check import describe_allowed
from synpick_warp.configs.episodes.randomize import Distribution
from synpick_warp.configs.fields import Setting, settings_of
from synpick_warp.configs.files.load import sections, table_lists
from synpick_warp.configs.files.table_lists import SPLITS, given_values
from synpick_warp.configs.schema import Config, Split

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
        value = os.path.abspath(given[name]) if item.path and given[name] else given[name]
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
