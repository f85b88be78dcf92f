"""Settings that all writers of a data set share: sections, and values that follow from others."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.configs.modes import bake_modes
from synpick_warp.configs.schema import Bake, Bop, Cameras, Config, Physics
from synpick_warp.configs.sensors import effect_ranges
from synpick_warp.configs.splits import DataLayout


@dataclass(frozen=True)
class ExportSettings:
    """Settings by which files are written: what all views and episodes of a data set have in common."""

    layout: DataLayout
    bake: Bake
    bop: Bop
    cameras: Cameras
    physics: Physics
    layers: tuple[str, ...]
    """Names of the layers of a view."""
    effects: tuple[str, ...]
    """Names of the camera effects that are on."""
    objects: int
    """Maximum number of objects of an episode."""
    stores_steps: bool
    """Whether each physics step is stored, not only each tick."""

    @classmethod
    def of(cls, config: Config) -> ExportSettings:
        """Those of all settings."""
        effects = tuple(name for name, limits in effect_ranges(config.effects).items() if any(limits))
        layout, objects, layers = DataLayout.of(config), config.arrangement.max_objects, config.render.layers
        return cls(layout, config.bake, config.bop, config.cameras, config.physics, layers, effects, objects, config.trajectory.steps)

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes of the data set or of its splits."""
        return bake_modes(self.bake, self.layout.splits)
