"""Light maps for USD: EXR files, and what a stage's lights need to know of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.exporters.exr import encode_exr
from synpick_warp.scenes.shapes import LightMap, Sun
from synpick_warp.scenes.skies import directions

WHITE_VALUE = 1.25
"""Display value, linear, of a white diffuse surface that faces up and sees the whole map: that of the pictures."""
SUN_ROWS = 256
"""Rows of the map in which a set's sun is looked for; this and what follows is the rule of the pictures (stages/light_tables.py)."""
SUN_RADIUS = 15.0
"""What is bright within this angle of a set's sun is taken out of its map [°]."""
SUN_CONTRAST = 4.0
"""Bright is what exceeds the map's mean by this factor."""
LEAST_SPREAD, MOST_SPREAD = np.tan(np.radians((0.267, 4.0)))
"""Tangents of a sun's angular radius: the sky's own, and that above which it is no light of its own but a disc in its map."""
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
    sun_angle: float
    """Angular diameter of the sun [°]."""


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
    radiance, irradiance, spread = part_sun(light)
    upward = np.maximum(directions(len(radiance))[..., 2], 0.0) * _solid_angles(len(radiance))
    white = np.einsum("ij,ijc->c", upward, radiance)
    azimuth = polar = 0.0
    sun = None
    if light.sun is not None and irradiance.any():
        x, y, z = light.sun.direction
        azimuth, polar = np.degrees(np.arctan2(y, x)), np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
        white = white + max(z, 0.0) * irradiance
        sun = (float(irradiance[0]), float(irradiance[1]), float(irradiance[2]))
    factor = exposure * WHITE_VALUE * np.pi / max(float(white @ _LUMINANCE), 1e-9)
    angle = float(2.0 * np.degrees(np.arctan(spread)))
    return StageLight(light.name, light_file(index), float(factor), float(azimuth), float(polar), sun, angle)


def write_light_maps(library: Path, lights: tuple[LightMap, ...]) -> None:
    """Write all maps into the asset library; `lights/` must exist.

    As in OpenEXR, longitude grows to the left as seen in the picture, and is 0 in its middle: it is the azimuth here.
    """
    for index, light in enumerate(lights):
        picture = part_sun(light)[0][:, ::-1].astype(np.float32)
        (library / light_file(index)).write_bytes(encode_exr(picture))


def part_sun(light: LightMap) -> tuple[np.ndarray, np.ndarray, float]:
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
    coarse = _resized(radiance, SUN_ROWS)
    share = _share_of_sun(coarse, sun)
    taken = share[..., None] * coarse * _solid_angles(SUN_ROWS)[..., None]
    gain = max(1.0, float(taken.sum(axis=(0, 1)) @ _LUMINANCE) / float(sun.irradiance @ _LUMINANCE))
    irradiance = gain * sun.irradiance
    # The same share of all texels for which one of the coarse map stands: so the same light is taken.
    fine = _resized(share, len(radiance), cv2.INTER_NEAREST)
    rest = radiance * (1.0 - fine)[..., None]
    spread = max(_spread(taken @ _LUMINANCE), float(LEAST_SPREAD))
    if spread > MOST_SPREAD:
        return rest + _disc(fine > 0.0, sun.direction, spread)[..., None] * irradiance, np.zeros(3), spread
    return rest, irradiance, spread


def _resized(image: np.ndarray, rows: int, enlarge: int = cv2.INTER_LINEAR) -> np.ndarray:
    """A map with so many rows and twice as many columns, by area if they are fewer."""
    method = cv2.INTER_AREA if rows <= len(image) else enlarge
    return cv2.resize(image.astype(np.float32), (2 * rows, rows), interpolation=method).astype(np.float64)


def _share_of_sun(radiance: np.ndarray, sun: Sun) -> np.ndarray:
    """Which share of each texel's light (rows, 2 rows) is the sun's."""
    toward, solid, bright = directions(len(radiance)), _solid_angles(len(radiance)), radiance @ _LUMINANCE
    threshold = SUN_CONTRAST * (bright * solid).sum() / (4.0 * np.pi)
    near = (toward @ sun.direction > np.cos(np.radians(SUN_RADIUS))) & (toward[..., 2] > 0.0) & (bright > threshold)
    return np.where(near, 1.0 - threshold / np.maximum(bright, 1e-12), 0.0)


def _spread(weight: np.ndarray) -> float:
    """Tangent of the angular radius of a disc that is as spread as these weights of texels (rows, 2 rows); 0: there are none."""
    if weight.sum() <= 0.0:
        return 0.0
    toward = directions(len(weight))
    middle = (weight[..., None] * toward).sum(axis=(0, 1))
    middle /= np.linalg.norm(middle)
    # The mean squared sine over a disc is half the squared sine of its radius.
    sine = np.sqrt(np.clip(2.0 * (weight * (1.0 - (toward @ middle) ** 2)).sum() / weight.sum(), 0.0, 0.25))
    return float(sine / np.sqrt(1.0 - sine**2))


def _disc(bright: np.ndarray, direction: np.ndarray, spread: float) -> np.ndarray:
    """A map (H, 2H), black but for a disc above the horizon, where `bright` if it meets that, of irradiance 1 on what faces it."""
    cosine = directions(len(bright)) @ direction
    cosine[directions(len(bright))[..., 2] <= 0.0] = -1.0
    inside = cosine >= min(1.0 / np.sqrt(1.0 + spread**2), cosine.max())
    if (inside & bright).any():
        inside &= bright
    return inside / (cosine * _solid_angles(len(bright)))[inside].sum()


def _solid_angles(rows: int) -> np.ndarray:
    """Of a map's texels (rows, 2 rows) [sr]."""
    edges = np.cos(np.arange(rows + 1) / rows * np.pi)
    return np.repeat((edges[:-1] - edges[1:])[:, None], 2 * rows, axis=1) * (np.pi / rows)
