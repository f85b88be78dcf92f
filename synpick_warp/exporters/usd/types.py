"""Plain descriptions that the bake sends to the writer processes of USD episodes. Imports neither pxr nor OpenCV."""

from dataclasses import dataclass, replace

from synpick_warp.codes import LookPart
from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.scenes.types import FIRST_DISTRACTOR, Camera, Material


@dataclass(frozen=True)
class StageLight:
    """Environment map as a dome light, and its sun as a distant light."""

    name: str
    file: str
    """EXR file, relative to the asset library."""
    intensity: float
    """Factor from the map's radiance to display range."""
    sun_azimuth: float
    """Direction to the sun in the map's frame, counter-clockwise about +z from +x [°]."""
    sun_polar: float
    """Angle between +z and the direction to the sun [°]."""
    sun_irradiance: tuple[float, float, float] | None
    """Irradiance of a surface that faces the sun, linear RGB, in the map's units; None: no distant light."""
    sun_angle: float
    """Angular diameter of the sun [°]."""


TEXTURES = "textures"
"""Folder of textures in the asset library."""
FLOOR = Material((1.0, 1.0, 1.0), None, 0.0, 1.0)
"""Material of the floor before an episode draws its texture."""


@dataclass(frozen=True)
class AssetSurface:
    """Material of an asset, without the pixels of its texture."""

    material: Material
    texture: str | None
    """File of its texture, relative to the asset library; None: it has none."""

    @staticmethod
    def of(name: str, material: Material) -> "AssetSurface":
        """That of the asset of this name."""
        return AssetSurface(replace(material, texture=None), None if material.texture is None else texture_file(name))


def texture_file(name: str) -> str:
    """File of a texture, relative to the asset library: that of the asset of this name, or one of those that episodes draw from."""
    return f"{TEXTURES}/{name}.png"


def drawn_texture(part: LookPart, index: int) -> str:
    """Name of a texture that episodes draw for the bin, the table or the background."""
    return f"{part.name.lower()}_{index:03d}"


@dataclass(frozen=True)
class UsdSettings:
    """Settings common to all episodes."""

    tick_rate: float
    """Frames per second of simulated time [1/s]."""
    gravity: float
    """[m/s²]"""
    bins: tuple[str | None, ...]
    """Asset of each bin; None: there is nothing but the table."""
    cameras: tuple[Camera, ...]
    lights: tuple[StageLight, ...]
    names: dict[int, str]
    """obj_id -> name of the object."""
    surfaces: dict[str, AssetSurface]
    """Materials by asset, of those that looks are drawn for; empty: looks are not randomized."""


def bin_asset(sizes: BinSizes) -> str:
    """Name of a bin's asset."""
    return sizes.name if sizes.noun == sizes.name else f"bin_{sizes.name}"


def object_asset(obj_id: int) -> str:
    """Name of an object's asset: stem of its file, and name of its root prim. Distractors have obj_ids from FIRST_DISTRACTOR downwards."""
    return f"obj_{obj_id:06d}" if obj_id >= 0 else f"distractor_{FIRST_DISTRACTOR - obj_id:06d}"
