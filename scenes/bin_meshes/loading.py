"""Settings loading, with what the meshes of bins measure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from synpick_warp.configs.cell.bins import BinRow
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config


def load_settings(
    preset_or_file: Path | str | None = None,
    settings: Mapping[str, object] | None = None,
    *,
    source: str = "in the settings passed",
    splits: bool = False,
) -> Config:
    """Load a preset or a TOML file as `load_config` does, and measure the meshes of its bins.

    Args:
        preset_or_file, settings, source, splits: As of `load_config`.

    Raises:
        ConfigError: As of `load_config`, or a mesh cannot be used as a bin.
    """
    return load_config(preset_or_file, settings, source=source, splits=splits, measure=_measure)


def _measure(rows: tuple[BinRow, ...]) -> dict[str, tuple[BinRow, ...]]:
    """As `measure_bins`."""
    if not any(row.file for row in rows):
        return {}
    # Readers of meshes take a while to import.
    from synpick_warp.scenes.bin_meshes.reading import measure_bins

    return measure_bins(rows)
