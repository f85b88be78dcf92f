"""Settings loading, with what the meshes of bins and gripper measure."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from synpick_warp.configs.cell.bins import BinRow
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config


def load_settings(
    preset_or_file: Path | str | None = None,
    settings: Mapping[str, object] | None = None,
    *,
    source: str = "in the settings passed",
    splits: bool = False,
) -> Config:
    """Load a preset or a TOML file as `load_config` does, and measure the meshes of its bins and gripper. Arguments: as of
    `load_config`. Raises ConfigError: as of `load_config`, or a mesh cannot be used."""
    return load_config(preset_or_file, settings, source=source, splits=splits, measure=measure_meshes)


def measure_meshes(rows: tuple[BinRow, ...], gripper: Gripper) -> dict[str, Any]:
    """Settings, for `override_config`, with what the meshes of bins and gripper measure; none if they have it. Raises ConfigError: a mesh
    cannot be used."""
    if not any(row.file for row in rows) and not gripper.mesh and not gripper.mesh_checksum:
        return {}
    # Readers of meshes take a while to import.
    from synpick_warp.scenes.bin_meshes.reading import measure_bins
    from synpick_warp.scenes.props import measure_tool

    return {**measure_bins(rows), **measure_tool(gripper)}
