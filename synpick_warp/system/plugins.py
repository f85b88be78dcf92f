"""Plug-ins: formats, grippers and layers of other installed packages, by their entry points.

    [project.entry-points."synpick_warp.formats"]
    boxes = "my_package.boxes:FORMAT"         # a synpick_warp.exporters.formats.Format

    [project.entry-points."synpick_warp.grippers"]
    triangle = "my_package.triangle"          # a module with make_head(gripper) and BEHAVIOR

    [project.entry-points."synpick_warp.layers"]
    range = "my_package.range:LAYER"          # has the members of synpick_warp.views.layers.Layer

Names are known without an import of the package; a module is imported when its name is first used, that of a layer by every bake and in its
writers, so it imports little. Names of this package stay its own. A file of its own, since settings, scenes, stages and exporters read it.
"""

import functools
from importlib import metadata
from typing import Any, Literal

from synpick_warp.errors import ConfigError

Group = Literal["formats", "grippers", "layers"]


@functools.cache
def plugin_names(group: Group, own: tuple[str, ...]) -> tuple[str, ...]:
    """Names of a group's plug-ins, sorted, without those of this package."""
    return tuple(sorted(metadata.entry_points(group=f"synpick_warp.{group}").names - set(own)))


@functools.cache
def load_plugin(group: Group, name: str, *members: str) -> Any:
    """Import a plug-in, which must have these members. Raises ConfigError: its package cannot be imported, two packages have one of this
    name, or it is something else."""
    known = f'"{name}" of the entry points synpick_warp.{group}'
    entries = metadata.entry_points(group=f"synpick_warp.{group}", name=name)
    if len(entries) != 1:
        raise ConfigError(f"{known} is in {len(entries)} packages; remove all but one")
    (entry,) = entries
    try:
        plugin = entry.load()
    except Exception as error:  # Whatever the code of others raises.
        raise ConfigError(f"{known} cannot be loaded: {type(error).__name__}: {error}") from None
    if missing := [member for member in members if not hasattr(plugin, member)]:
        raise ConfigError(f"{known} is {entry.value}, which has no {' and no '.join(missing)}; see synpick_warp/system/plugins.py")
    return plugin
