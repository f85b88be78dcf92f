"""Suns of sIBL sets: the sun that a set names replaces what its environment map shows there, so that no light counts twice.

Renderer (`scenes.lamps`) and USD export treat it as a light of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from synpick_warp.scenes.environment import LUMINANCE, map_directions
from synpick_warp.scenes.types import Sun
from synpick_warp.system.linear_algebra import DECIMALS, dot, norm

SUN_SEARCH_RADIUS = np.radians(15.0)
"""Texels within this angle of its direction can belong to the sun [rad]."""
SUN_CONTRAST = 4.0
"""The part of a texel's luminance above this multiple of the map's mean belongs to the sun."""
MAX_SUN_TANGENT = np.tan(np.radians(4.0)).round(DECIMALS)
"""Tangent of the maximum angular radius of a sun that is a light of its own. A larger one is drawn into the map as a disc."""
SOLAR_TANGENT = np.tan(np.radians(0.267)).round(DECIMALS)
"""Tangent of the real sun's angular radius: the minimum for an sIBL set's sun."""


class ExtractedSun(NamedTuple):
    """Sun of an environment map, and the map without it."""

    rest: np.ndarray
    """The map without the sun (rows, 2 rows, 3)."""
    direction: np.ndarray
    """Unit direction to the sun (3)."""
    irradiance: np.ndarray
    """Irradiance on a surface that faces the sun (3); zero if the map is not bright there."""
    radius_tangent: float
    """Tangent of the angular radius of the sun."""


def extract_sun(radiance: np.ndarray, direction: np.ndarray) -> ExtractedSun:
    """Split a map into the bright light around a direction, above the horizon, and the rest.

    Args:
        radiance: (rows, 2 rows, 3).
        direction: Unit direction (3) to extract light around.
    """
    directions, solid_angles = map_directions(radiance.shape[0])
    luminance = dot(radiance, LUMINANCE)
    fraction = sun_fraction(radiance, direction)
    weight = fraction * luminance * solid_angles
    if weight.sum() <= 0.0:
        return ExtractedSun(radiance, np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0)
    center = (weight[..., None] * directions).sum(axis=(0, 1))
    center /= norm(center)
    irradiance = (radiance * (fraction * solid_angles)[..., None]).sum(axis=(0, 1))
    return ExtractedSun(radiance * (1.0 - fraction)[..., None], center, irradiance, disc_radius_tangent(weight, center))


def sun_fraction(radiance: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Fraction (rows, 2 rows) of each texel's radiance that belongs to the sun about a unit direction (3), from 0 to below 1.

    1 - t / luminance within SUN_SEARCH_RADIUS, above the horizon and where luminance exceeds t = SUN_CONTRAST · the map's mean; else 0.
    """
    directions, solid_angles = map_directions(radiance.shape[0])
    luminance = dot(radiance, LUMINANCE)
    threshold = SUN_CONTRAST * (luminance * solid_angles).sum() / (4.0 * np.pi)
    near = dot(directions, direction) > np.cos(SUN_SEARCH_RADIUS).round(DECIMALS)
    near &= (directions[..., 2] > 0.0) & (luminance > threshold)
    return np.where(near, 1.0 - threshold / np.maximum(luminance, 1e-12), 0.0)


def disc_radius_tangent(weight: np.ndarray, direction: np.ndarray) -> float:
    """Tangent of the angular radius of a uniform disc about a direction (3) with the second moment of texel weights.

    Args:
        weight: Luminance times solid angle of each texel (rows, 2 rows).
        direction: Unit direction (3).
    """
    directions, _ = map_directions(len(weight))
    # The mean squared sine over a disc is half the squared sine of its radius.
    sine = np.sqrt(np.clip(2.0 * (weight * (1.0 - dot(directions, direction) ** 2)).sum() / weight.sum(), 0.0, 0.25))
    return float(sine / np.sqrt(1.0 - sine**2))


def replace_sun(radiance: np.ndarray, sun: Sun) -> ExtractedSun:
    """Replace the bright place of a map by the sun that its sIBL set names.

    The sun has the set's direction and colour; its luminance is the larger one of the set's sun and the light it replaces: a clipped map
    lacks light, while a map that holds its sun unclipped is more exact than a number set by eye. Its angular radius is that of the
    light it replaces, but no less than the real sun's.

    Args:
        radiance: (rows, 2 rows, 3).
        sun: The set's sun.
    """
    taken = extract_sun(radiance, sun.direction)
    gain = max(1.0, float(dot(taken.irradiance, LUMINANCE) / dot(sun.irradiance, LUMINANCE)))
    return ExtractedSun(taken.rest, sun.direction, gain * sun.irradiance, max(taken.radius_tangent, float(SOLAR_TANGENT)))


def draw_sun_disc(bright: np.ndarray, direction: np.ndarray, irradiance: np.ndarray, radius_tangent: float) -> np.ndarray:
    """Render a sun as a uniform disc into a black map (rows, 2 rows, 3), with the given irradiance on a surface that faces it.

    Args:
        bright: Texels where the map is bright (rows, 2 rows) bool. If any lies in the disc, the disc keeps only these: hills hide the
            rest.
        direction: Unit direction (3) to the disc's centre, above the horizon.
        irradiance: (3).
        radius_tangent: Tangent of the disc's angular radius; the disc has at least one texel.
    """
    directions, solid_angles = map_directions(len(bright))
    cosine = np.where(directions[..., 2] > 0.0, dot(directions, direction), -1.0)
    inside = cosine >= min(1.0 / np.sqrt(1.0 + radius_tangent**2), cosine.max())
    if (inside & bright).any():
        inside &= bright
    return inside[..., None] * irradiance / (cosine * solid_angles)[inside].sum()
