"""Writes settings as TOML: complete, and readable again by `load_config` to the same settings."""

from __future__ import annotations

import json
from typing import Any

from synpick_warp.configs.check import allowed
from synpick_warp.configs.load import ROWS, sections, settings_of
from synpick_warp.configs.schema import Config, ObjectRow

_DELETE = "\x7f"
"""The one control character that JSON leaves as it is and TOML forbids."""


def config_to_toml(config: Config, *, comments: bool = False) -> str:
    """All settings as TOML, those that nobody set as well.

    Args:
        config: Settings.
        comments: Put meaning, unit and range above each.
    """
    lines = [] if config.object_rows else [f"{ROWS} = []", ""]
    for section, kind in sections().items():
        if comments and kind.__doc__:
            lines += [f"# {' '.join(kind.__doc__.split())}"]
        lines += [f"[{section}]", *_table(getattr(config, section), kind, comments), ""]
    for number, row in enumerate(config.object_rows):
        lines += [f"[[{ROWS}]]", *_table(row, ObjectRow, comments and number == 0), ""]
    return "\n".join(lines)


def _table(values: Any, kind: type[Any], comments: bool) -> list[str]:
    lines = []
    for name, (item, annotation) in settings_of(kind).items():
        if comments:
            unit = f"[{item.metadata['unit']}] " if item.metadata["unit"] else ""
            lines.append(f"# {item.metadata['doc']} {unit}Allowed: {allowed(item, annotation)}.")
        lines.append(f"{name} = {_toml(getattr(values, name))}")
    return lines


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(_DELETE, "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    return repr(value)
