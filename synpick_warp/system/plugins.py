"""Plug-ins: formats and grippers of other installed packages, by their entry points.

    [project.entry-points."synpick_warp.formats"]
    boxes = "my_package.boxes:FORMAT"         # a synpick_warp.exporters.formats.Format

    [project.entry-points."synpick_warp.grippers"]
    triangle = "my_package.triangle"          # a module with make_head(gripper) and BEHAVIOR

Names are known without an import of the package; a module is imported when its name is first used. A file of its own, since settings,
scenes, stages and exporters all read it.
"""

from __future__ import annotations

import functools
from importlib import metadata
from typing import Any, Literal

from synpick_warp.errors import ConfigError

Group = Literal["formats", "grippers"]


@functools.cache
def plugin_names(group: Group) -> tuple[str, ...]:
    """Names of a group's plug-ins, sorted."""
    return tuple(sorted(metadata.entry_points(group=f"synpick_warp.{group}").names))


@functools.cache
def load_plugin(group: Group, name: str) -> Any:
    """Import a plug-in.

    Raises:
        ConfigError: Its package cannot be imported.
    """
    try:
        (entry,) = metadata.entry_points(group=f"synpick_warp.{group}", name=name)
        return entry.load()
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f'"{name}" of the entry points synpick_warp.{group} cannot be loaded: {error}') from None
