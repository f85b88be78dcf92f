"""Light maps for USD: EXR files, and what a stage's lights need to know of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.exporters.usd.exr import encode_exr
from synpick_warp.scenes.environment import BACKGROUND_ROWS, LUMINANCE, WHITE_VALUE, map_directions, resize_map
from synpick_warp.scenes.sun import MAX_SUN_ANGULAR_RADIUS, draw_sun_disc, replace_sun, sun_fraction
from synpick_warp.scenes.types import EnvironmentMap


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
    sun_angle: float
    """Angular diameter of the sun [°]."""


def light_file(index: int) -> str:
    """Where a light map lies in the asset library."""
    return f"lights/light_{index:03d}.exr"


def stage_light(index: int, light: EnvironmentMap, exposure: float) -> StageLight:
    """What a stage needs to know of a light map.

    Args:
        index: Its index in the bake.
        light: The map.
        exposure: Factor on the automatic exposure.
    """
    radiance, irradiance, spread = part_sun(light)
    directions, solid = map_directions(len(radiance))
    upward = np.maximum(directions[..., 2], 0.0) * solid
    white = np.einsum("ij,ijc->c", upward, radiance)
    azimuth = polar = 0.0
    sun = None
    if light.sun is not None and irradiance.any():
        x, y, z = light.sun.direction
        azimuth, polar = np.degrees(np.arctan2(y, x)), np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
        white = white + max(z, 0.0) * irradiance
        sun = (float(irradiance[0]), float(irradiance[1]), float(irradiance[2]))
    factor = exposure * WHITE_VALUE * np.pi / max(float(white @ LUMINANCE), 1e-9)
    angle = float(2.0 * np.degrees(np.arctan(spread)))
    return StageLight(light.name, light_file(index), float(factor), float(azimuth), float(polar), sun, angle)


def write_light_maps(library: Path, lights: tuple[EnvironmentMap, ...]) -> None:
    """Write all maps into the asset library; `lights/` must exist.

    As in OpenEXR, longitude grows to the left as seen in the picture, and is 0 in its middle: it is the azimuth here.
    """
    for index, light in enumerate(lights):
        picture = part_sun(light)[0][:, ::-1].astype(np.float32)
        (library / light_file(index)).write_bytes(encode_exr(picture))


def part_sun(light: EnvironmentMap) -> tuple[np.ndarray, np.ndarray, float]:
    """Part a map and its sun so that no light counts twice, by the rule of the pictures.

    The sun has the set's colour, and the set's luminance or that of the bright place for which it stands, whichever is more.

    Returns:
        The map (H, 2H, 3) without that place, or with a disc in its stead if the sun is wide; the sun's irradiance (3), zero: it has
        none, or is that disc; tangent of its angular radius.
    """
    sun = light.sun
    if sun is None:
        return light.radiance, np.zeros(3), 0.0
    radiance = light.radiance.astype(np.float64)
    coarse = resize_map(radiance, BACKGROUND_ROWS)
    _, direction, irradiance, spread = replace_sun(coarse, sun)
    # The same share of all texels for which one of the coarse map stands: so the same light is taken.
    share = sun_fraction(coarse, direction).astype(np.float32)
    rows = len(radiance)
    method = cv2.INTER_AREA if rows <= BACKGROUND_ROWS else cv2.INTER_NEAREST
    fine = cv2.resize(share, (2 * rows, rows), interpolation=method).astype(np.float64)
    rest = radiance * (1.0 - fine)[..., None]
    if spread > MAX_SUN_ANGULAR_RADIUS:
        return rest + draw_sun_disc(fine > 0.0, direction, irradiance, spread), np.zeros(3), spread
    return rest, irradiance, spread
