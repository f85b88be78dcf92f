"""Settings of a stream: a preset, a file or a `Config`, overridden by full keys and by keyword arguments."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from synpick_warp.configs.files.load import override_config
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.bin_meshes.loading import load_settings, measure_meshes

ARGUMENTS = {
    "worlds": "bake.worlds",
    "device": "bake.device",
    "seed": "bake.seed",
    "mode": "bake.mode",
    "models": "bake.models",
    "lights": "bake.lights",
    "resolution": "cameras.resolution",
    "layers": "render.layers",
    "batch": "render.views_per_batch",
}
"""Full key of the setting that each keyword argument of `synpick_warp.stream` overrides."""


def resolve_settings(
    config: Config | Path | str | None, settings: Mapping[str, object], arguments: Mapping[str, object], splits: bool = False
) -> Config:
    """Resolve the settings of a stream; arguments override full keys, and both the configuration.

    Args:
        config: A configuration, or a preset's name or a .toml file; None: the default preset.
        settings: Full key, such as "bake.mode", -> value.
        arguments: Key of ARGUMENTS -> value; None: not given.
        splits: Whether the splits that a preset defines apply; those of a file always do.

    Raises:
        ConfigError: A setting is unknown or not allowed.
    """
    given = {ARGUMENTS[name]: value for name, value in arguments.items() if value is not None}
    if given.get("bake.worlds") == "auto":  # As the command line has it.
        given["bake.worlds"] = 0
    overrides = dict(settings) | given
    if not isinstance(config, Config):
        return load_settings(config, overrides, splits=splits)
    config = override_config(config, overrides)
    return override_config(config, measure_meshes(config.bin, config.gripper))
