"""Light maps for USD: EXR files, and what a stage's lights need to know of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synpick_warp.exporters.exr import encode_exr
from synpick_warp.scenes.shapes import LightMap, Sun
from synpick_warp.scenes.skies import directions

WHITE_VALUE = 1.25
"""Display value, linear, of a white diffuse surface that faces up and sees the whole map: that of the pictures."""
SUN_RADIUS = 15.0
"""What is bright within this angle of a set's sun is taken out of its map [°], as for the pictures."""
SUN_CONTRAST = 4.0
"""Bright is what exceeds the map's mean by this factor; likewise."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec. 709."""


@dataclass(frozen=True)
class StageLight:
    """A light map as a stage has it."""

    name: str
    file: str
    """Relative to the asset library."""
    intensity: float
    """Factor that brings the map's radiance to display range."""
    sun_azimuth: float
    """Direction to the sun in the map's frame, counter-clockwise about +z from +x [°]."""
    sun_polar: float
    """Angle between +z and the direction to the sun [°]."""
    sun_irradiance: tuple[float, float, float] | None
    """Linear RGB on a surface that faces it, in the map's units; None: no sun."""


def light_file(index: int) -> str:
    """Where a light map lies in the asset library."""
    return f"lights/light_{index:03d}.exr"


def stage_light(index: int, light: LightMap, exposure: float) -> StageLight:
    """What a stage needs to know of a light map.

    Args:
        index: Its index in the bake.
        light: The map.
        exposure: Factor on the automatic exposure.
    """
    radiance, irradiance = part_sun(light)
    upward = np.maximum(directions(len(radiance))[..., 2], 0.0) * _solid_angles(len(radiance))
    white = np.einsum("ij,ijc->c", upward, radiance)
    azimuth = polar = 0.0
    if light.sun is not None:
        x, y, z = light.sun.direction
        azimuth, polar = np.degrees(np.arctan2(y, x)), np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
        white = white + max(z, 0.0) * irradiance
    sun = None if light.sun is None else (float(irradiance[0]), float(irradiance[1]), float(irradiance[2]))
    factor = exposure * WHITE_VALUE * np.pi / max(float(white @ _LUMINANCE), 1e-9)
    return StageLight(light.name, light_file(index), float(factor), float(azimuth), float(polar), sun)


def write_light_maps(library: Path, lights: tuple[LightMap, ...]) -> None:
    """Write all maps into the asset library; `lights/` must exist.

    As in OpenEXR, longitude grows to the left as seen in the picture, and is 0 in its middle: it is the azimuth here.
    """
    for index, light in enumerate(lights):
        picture = part_sun(light)[0][:, ::-1].astype(np.float32)
        (library / light_file(index)).write_bytes(encode_exr(picture))


def part_sun(light: LightMap) -> tuple[np.ndarray, np.ndarray]:
    """A map (H, 2H, 3) without the bright place for which its sun stands, so that no light counts twice, and the sun's irradiance (3).

    The sun has the set's colour, and the set's luminance or that of what it replaces, whichever is more: the rule of the pictures.
    """
    sun = light.sun
    if sun is None:
        return light.radiance, np.zeros(3)
    radiance = light.radiance.astype(np.float64)
    share, solid = _share_of_sun(radiance, sun), _solid_angles(len(radiance))
    taken = np.einsum("ij,ijc->c", share * solid, radiance)
    gain = max(1.0, float(taken @ _LUMINANCE) / float(sun.irradiance @ _LUMINANCE))
    return radiance * (1.0 - share)[..., None], gain * sun.irradiance


def _share_of_sun(radiance: np.ndarray, sun: Sun) -> np.ndarray:
    """Which share of each texel's light (H, 2H) is the sun's."""
    toward, solid, bright = directions(len(radiance)), _solid_angles(len(radiance)), radiance @ _LUMINANCE
    threshold = SUN_CONTRAST * (bright * solid).sum() / (4.0 * np.pi)
    near = (toward @ sun.direction > np.cos(np.radians(SUN_RADIUS))) & (toward[..., 2] > 0.0) & (bright > threshold)
    return np.where(near, 1.0 - threshold / np.maximum(bright, 1e-12), 0.0)


def _solid_angles(rows: int) -> np.ndarray:
    """Of a map's texels (rows, 2 rows) [sr]."""
    edges = np.cos(np.arange(rows + 1) / rows * np.pi)
    return np.repeat((edges[:-1] - edges[1:])[:, None], 2 * rows, axis=1) * (np.pi / rows)
