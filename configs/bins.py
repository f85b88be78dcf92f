"""Settings of the bins that stand under the cameras."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.configs.fields import setting


@dataclass(frozen=True)
class Tote:
    """The tote (an open box). Its frame is the world frame: origin at the centre of the inner floor, z up. Sizes of the released mesh."""

    outer_size: tuple[float, float, float] = setting((0.615, 0.373, 0.200), "m", "Outer length, width and height.", above=0.0, high=10.0)
    floor_size: tuple[float, float] = setting((0.513, 0.319), "m", "Length and width of the inner floor.", above=0.0, high=10.0)
    rim_size: tuple[float, float] = setting((0.545, 0.352), "m", "Length and width of the opening at the rim.", above=0.0, high=10.0)
    wall: float = setting(0.0045, "m", "Thickness of walls and floor.", above=0.0, high=1.0)
    color: tuple[float, float, float] = setting((0.65, 0.05, 0.04), "sRGB", "Base colour.", low=0.0, high=1.0)
    metallic: float = setting(0.0, "", "Metallic factor.", low=0.0, high=1.0)
    roughness: float = setting(0.5, "", "Roughness.", low=0.0, high=1.0)
