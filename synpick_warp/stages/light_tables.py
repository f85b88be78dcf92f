"""What the renderer needs to know of a light map: main light, diffuse irradiance, blurred reflections, exposure."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from synpick_warp.kernels.environment import REFLECTION_LEVELS
from synpick_warp.scenes.shapes import LightMap, Sun

BACKGROUND_ROWS = 256
"""Rows of the background, which is what a camera out of focus would see; 0.7° a texel tells lamps apart."""
REFLECTION_ROWS = 32
"""Rows of the blurred reflections: the sharpest lobe kept is wider than a texel of 5.6°."""
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
COSINE_LOBE = np.array([np.pi] + [2.0 * np.pi / 3.0] * 3 + [np.pi / 4.0] * 5)
"""Convolution with the cosine, by spherical harmonic (Ramamoorthi and Hanrahan, 2001)."""


@dataclass(frozen=True, eq=False)
class LightTable:
    """One light map, ready for `kernels.environment.Lights`."""

    background: np.ndarray
    """(BACKGROUND_ROWS, 2 BACKGROUND_ROWS, 3) float32: all light of the map, with a set's sun as a disc."""
    rest: np.ndarray
    """The same without the main light."""
    reflection: np.ndarray
    """(levels, REFLECTION_ROWS, 2 REFLECTION_ROWS, 3) float32."""
    irradiance: np.ndarray
    """(9, 3) float32."""
    main_direction: np.ndarray
    """(3) float32, unit."""
    main_irradiance: np.ndarray
    """(3) float32; zero: no main light."""
    main_spread: float
    exposure: float


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


def harmonics(directions: np.ndarray) -> np.ndarray:
    """The nine real spherical harmonics up to order 2 at unit directions (..., 3), in the order of `diffuse_irradiance`."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack(
        [
            np.full_like(x, 0.282095),
            0.488603 * y,
            0.488603 * z,
            0.488603 * x,
            1.092548 * x * y,
            1.092548 * y * z,
            0.315392 * (3.0 * z * z - 1.0),
            1.092548 * x * z,
            0.546274 * (x * x - y * y),
        ],
        axis=-1,
    )


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
    threshold = MAIN_LIGHT_CONTRAST * (bright * solid).sum() / (4.0 * np.pi)
    smooth = np.where(directions[..., 2] > MAIN_LIGHT_MIN_HEIGHT, cv2.GaussianBlur(bright, (0, 0), 1.5), -1.0)
    peak = directions[np.unravel_index(np.argmax(smooth), smooth.shape)] if place is None else place
    near = (directions @ peak > np.cos(MAIN_LIGHT_RADIUS)) & (directions[..., 2] > 0.0) & (bright > threshold)
    share = np.where(near, 1.0 - threshold / np.maximum(bright, 1e-12), 0.0)
    weight = share * bright * solid
    if weight.sum() <= 0.0:
        return radiance, np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0
    direction = (weight[..., None] * directions).sum(axis=(0, 1))
    direction /= np.linalg.norm(direction)
    irradiance = (radiance * (share * solid)[..., None]).sum(axis=(0, 1))
    # The mean squared sine over a disc is half the squared sine of its radius.
    sine = np.sqrt(np.clip(2.0 * (weight * (1.0 - (directions @ direction) ** 2)).sum() / weight.sum(), 0.0, 0.25))
    return radiance * (1.0 - share)[..., None], direction, irradiance, float(sine / np.sqrt(1.0 - sine**2))


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


def blurred_reflections(radiance: np.ndarray) -> np.ndarray:
    """The map seen in rough mirrors: means over GGX lobes with the mirror seen from its normal (Karis, 2014).

    Args:
        radiance: (rows, 2 rows, 3).

    Returns:
        (REFLECTION_LEVELS, rows, 2 rows, 3).
    """
    rows = radiance.shape[0]
    directions, solid = map_directions(rows)
    incoming = directions.reshape(-1, 3)
    levels = []
    for level in range(int(REFLECTION_LEVELS)):
        alpha2 = ((level + 1.0) / int(REFLECTION_LEVELS)) ** 4
        # All columns of a row see the map alike, turned: one lobe a row, correlated along the columns by the Fourier transform.
        axes = directions[:, 0]
        cosine = axes @ incoming.T
        half2 = (1.0 + cosine) / 2.0
        lobe = np.where(cosine > 0.0, cosine * alpha2 / (half2 * (alpha2 - 1.0) + 1.0) ** 2, 0.0) * solid.reshape(-1)
        lobe = (lobe / lobe.sum(axis=1, keepdims=True)).reshape(rows, rows, 2 * rows)
        spectrum = np.einsum("aij,ijc->ajc", np.conj(np.fft.fft(lobe, axis=2)), np.fft.fft(radiance, axis=1), optimize=True)
        levels.append(np.fft.ifft(spectrum, axis=1).real)
    return np.maximum(np.stack(levels), 0.0)


def light_table(light: LightMap, ground: np.ndarray | None) -> LightTable:
    """Analyse one light map.

    Args:
        light: The map.
        ground: Linear albedo (3) of the table, which takes the place of the map below the horizon; None: no table.
    """
    background = resized(light.radiance, BACKGROUND_ROWS)
    directions, solid = map_directions(BACKGROUND_ROWS)
    rest, direction, irradiance, spread = split_main_light(background) if light.sun is None else replace_sun(background, light.sun)
    if light.sun is not None:
        background = rest + sun_disc((rest < background).any(axis=2), direction, irradiance, spread)
    if spread > MAIN_LIGHT_SPREAD:
        rest, irradiance = background, np.zeros(3)
    upward = np.maximum(directions[..., 2], 0.0) * solid
    upward_irradiance = (background * upward[..., None]).sum(axis=(0, 1))
    # What surfaces would see: the table hides the map below the horizon.
    even = rest if ground is None else np.where(directions[..., 2:] < 0.0, ground * upward_irradiance / np.pi, rest)
    coefficients = np.einsum("ijk,ijc->kc", harmonics(directions) * solid[..., None], even) * COSINE_LOBE[:, None]
    white = max(float(upward_irradiance @ LUMINANCE) / np.pi, 1e-9)
    return LightTable(
        background=background.astype(np.float32),
        rest=rest.astype(np.float32),
        reflection=blurred_reflections(resized(even, REFLECTION_ROWS)).astype(np.float32),
        irradiance=coefficients.astype(np.float32),
        main_direction=direction.astype(np.float32),
        main_irradiance=irradiance.astype(np.float32),
        main_spread=spread,
        exposure=WHITE_VALUE / white,
    )
