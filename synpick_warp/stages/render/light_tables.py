"""What the renderer needs to know of a light map: main light, diffuse irradiance, blurred reflections, exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synpick_warp.kernels.render.lighting.environment import REFLECTION_LEVELS
from synpick_warp.scenes.environment import BACKGROUND_ROWS, LUMINANCE, WHITE_VALUE, map_directions, resize_map
from synpick_warp.scenes.sun import MAX_SUN_ANGULAR_RADIUS, draw_sun_disc, extract_sun, replace_sun
from synpick_warp.scenes.types import EnvironmentMap

REFLECTION_ROWS = 32
"""Rows of the blurred reflections: the sharpest lobe kept is wider than a texel of 5.6°."""
COSINE_LOBE = np.array([np.pi] + [2.0 * np.pi / 3.0] * 3 + [np.pi / 4.0] * 5)
"""Convolution with the cosine, by spherical harmonic (Ramamoorthi and Hanrahan, 2001)."""


@dataclass(frozen=True, eq=False)
class LightTable:
    """One light map, ready for `kernels.render.lighting.environment.Lights`."""

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


def light_table(light: EnvironmentMap, ground: np.ndarray | None) -> LightTable:
    """Analyse one light map.

    Args:
        light: The map.
        ground: Linear albedo (3) of the table, which takes the place of the map below the horizon; None: no table.
    """
    background = resize_map(light.radiance, BACKGROUND_ROWS)
    directions, solid = map_directions(BACKGROUND_ROWS)
    rest, direction, irradiance, spread = extract_sun(background) if light.sun is None else replace_sun(background, light.sun)
    if light.sun is not None:
        background = rest + draw_sun_disc((rest < background).any(axis=2), direction, irradiance, spread)
    if spread > MAX_SUN_ANGULAR_RADIUS:
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
        reflection=blurred_reflections(resize_map(even, REFLECTION_ROWS)).astype(np.float32),
        irradiance=coefficients.astype(np.float32),
        main_direction=direction.astype(np.float32),
        main_irradiance=irradiance.astype(np.float32),
        main_spread=spread,
        exposure=WHITE_VALUE / white,
    )
