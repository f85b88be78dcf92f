"""The brightest place of a light map, or a set's sun: found, measured and taken out, so that no light counts twice."""

from __future__ import annotations

import cv2
import numpy as np

from synpick_warp.scenes.types import Sun

BACKGROUND_ROWS = 256
"""Rows of the background, which is what a camera out of focus would see; 0.7° a texel tells lamps apart."""
MAIN_LIGHT_RADIUS = np.radians(15.0)
"""The main light gathers what is bright within this angle of the brightest place."""
MAIN_LIGHT_CONTRAST = 4.0
"""Radiance counts as part of the main light as far as it exceeds the map's mean by this factor."""
MAIN_LIGHT_SPREAD = np.tan(np.radians(4.0))
"""Tangent of the largest angular radius of a main light: wider ones cast half-shadows that need no rays of their own."""
MAIN_LIGHT_MIN_HEIGHT = 0.15
"""Lowest z of the direction to a main light: lower ones light no pile in a tote."""
SUN_SPREAD = np.tan(np.radians(0.267))
"""Tangent of the sun's angular radius: the least that a set's sun has."""
WHITE_VALUE = 1.25
"""Display value, linear, of a white diffuse surface that faces up and sees the whole sky."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec. 709."""


def resized(radiance: np.ndarray, rows: int) -> np.ndarray:
    """The map with `rows` rows and twice as many columns, by area; energy is kept."""
    method = cv2.INTER_AREA if rows <= radiance.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(radiance.astype(np.float32), (2 * rows, rows), interpolation=method).astype(np.float64)


def map_directions(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (rows, 2 rows, 3) of a map's texel centres and their solid angles (rows, 2 rows) [sr]."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5) * 2.0 * np.pi
    polar, azimuth = np.meshgrid(polar, azimuth, indexing="ij")
    directions = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    edges = np.cos(np.arange(rows + 1) / rows * np.pi)
    solid = np.repeat((edges[:-1] - edges[1:])[:, None], 2 * rows, axis=1) * (2.0 * np.pi / (2 * rows))
    return directions, solid


def split_main_light(radiance: np.ndarray, place: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Part a map into its brightest place above the horizon and the rest.

    Args:
        radiance: (rows, 2 rows, 3).
        place: Unit direction (3) to look about instead of the brightest place's.

    Returns:
        The rest of the map, unit direction to the main light, its irradiance on a surface that faces it (3; zero if nothing stands
        out), tangent of the angular radius of a disc of the same spread.
    """
    directions, solid = map_directions(radiance.shape[0])
    bright = radiance @ LUMINANCE
    smooth = np.where(directions[..., 2] > MAIN_LIGHT_MIN_HEIGHT, cv2.GaussianBlur(bright, (0, 0), 1.5), -1.0)
    peak = directions[np.unravel_index(np.argmax(smooth), smooth.shape)] if place is None else place
    share = light_share(radiance, peak)
    weight = share * bright * solid
    if weight.sum() <= 0.0:
        return radiance, np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0
    direction = (weight[..., None] * directions).sum(axis=(0, 1))
    direction /= np.linalg.norm(direction)
    irradiance = (radiance * (share * solid)[..., None]).sum(axis=(0, 1))
    return radiance * (1.0 - share)[..., None], direction, irradiance, disc_spread(weight, direction)


def light_share(radiance: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Which share (rows, 2 rows) of each texel's light belongs to the bright place about a unit direction (3)."""
    directions, solid = map_directions(radiance.shape[0])
    bright = radiance @ LUMINANCE
    threshold = MAIN_LIGHT_CONTRAST * (bright * solid).sum() / (4.0 * np.pi)
    near = (directions @ place > np.cos(MAIN_LIGHT_RADIUS)) & (directions[..., 2] > 0.0) & (bright > threshold)
    return np.where(near, 1.0 - threshold / np.maximum(bright, 1e-12), 0.0)


def disc_spread(weight: np.ndarray, direction: np.ndarray) -> float:
    """Tangent of the angular radius of a disc about a direction (3) that is as spread as these weights of texels (rows, 2 rows)."""
    directions, _ = map_directions(len(weight))
    # The mean squared sine over a disc is half the squared sine of its radius.
    sine = np.sqrt(np.clip(2.0 * (weight * (1.0 - (directions @ direction) ** 2)).sum() / weight.sum(), 0.0, 0.25))
    return float(sine / np.sqrt(1.0 - sine**2))


def replace_sun(radiance: np.ndarray, sun: Sun) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Take the bright place out of a map for which a set's sun stands, so that no light counts twice.

    The sun has the set's direction and colour, and the set's luminance or that of what it replaces, whichever is more: a clipped
    map lacks light, one that holds its sun whole knows better than a number set by eye. It is as wide as what it replaces.

    Args:
        radiance: (rows, 2 rows, 3).
        sun: The set's sun.

    Returns:
        As `split_main_light` does.
    """
    rest, _, taken, spread = split_main_light(radiance, sun.direction)
    gain = max(1.0, float(taken @ LUMINANCE) / float(sun.irradiance @ LUMINANCE))
    return rest, sun.direction, gain * sun.irradiance, max(spread, float(SUN_SPREAD))


def sun_disc(bright: np.ndarray, direction: np.ndarray, irradiance: np.ndarray, spread: float) -> np.ndarray:
    """A map (rows, 2 rows, 3), black but for a disc above the horizon that gives this irradiance to what faces its middle.

    Args:
        bright: Where the map is bright (rows, 2 rows) bool; of a disc that meets such places the rest is left out, being hidden by hills.
        direction: Unit vector (3) to the disc's middle, above the horizon.
        irradiance: (3).
        spread: Tangent of its angular radius; it has at least one texel.
    """
    directions, solid = map_directions(len(bright))
    cosine = np.where(directions[..., 2] > 0.0, directions @ direction, -1.0)
    inside = cosine >= min(1.0 / np.sqrt(1.0 + spread**2), cosine.max())
    if (inside & bright).any():
        inside &= bright
    return inside[..., None] * irradiance / (cosine * solid)[inside].sum()
