"""Settings that all writers of a data set share: sections, and values that follow from others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.cell.sensors import effect_ranges
from synpick_warp.configs.dataset.splits import DataLayout, bake_modes
from synpick_warp.configs.schema import Bake, Bop, Config, Gripper, Physics, Render, Trajectory


@dataclass(frozen=True)
class ExportSettings:
    """Settings by which files are written: what all views and episodes of a data set have in common."""

    layout: DataLayout
    bake: Bake
    bop: Bop
    rig: Rig
    physics: Physics
    render: Render
    trajectory: Trajectory
    gripper: Gripper
    bins: tuple[BinSizes, ...]
    """Bins from which an episode draws its own."""
    effects: tuple[str, ...]
    """Names of the camera effects that are on."""
    objects: int
    """Maximum number of objects of an episode."""

    @classmethod
    def of(cls, config: Config) -> ExportSettings:
        """Those of all settings."""
        effects = tuple(name for name, limits in effect_ranges(config.effects).items() if any(limits))
        names = ("bake", "bop", "rig", "physics", "render", "trajectory", "gripper")
        sections: dict[str, Any] = {name: getattr(config, name) for name in names}
        return cls(layout=DataLayout.of(config), bins=config.cell.bins, effects=effects, objects=config.arrangement.max_objects, **sections)

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes of the data set or of its splits."""
        return bake_modes(self.bake, self.layout.splits)
