"""Tables that lighting precomputes: per environment map its lamps, SH irradiance, prefiltered specular map, exposure and sampling CDFs;
once per device the directional albedo of the GGX lobe."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting.brdf import ALBEDO_COLUMNS, ALBEDO_ROWS, AlbedoTables, measure_albedo_kernel
from synpick_warp.kernels.render.lighting.environment import MAX_LAMPS, PREFILTER_LEVELS
from synpick_warp.kernels.render.lighting.sampling import EnvironmentCdf
from synpick_warp.kernels.render.lighting.shadows import LAMP_POINTS
from synpick_warp.scenes import environment
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.system.hardware.cores import map_in_threads
from synpick_warp.system.linear_algebra import dot, matmul

PREFILTER_ROWS = 32
"""Rows of the prefiltered specular map: its sharpest lobe is wider than a texel of 5.6°."""
COSINE_LOBE = np.array([np.pi] + [2.0 * np.pi / 3.0] * 3 + [np.pi / 4.0] * 5)
"""Convolution with the clamped cosine, by spherical harmonic (Ramamoorthi and Hanrahan, 2001)."""
HORIZON_WEIGHT = 0.15
"""Importance of light from the horizon relative to luminance; light from the zenith has 1 more."""
MEAN_STEPS = 4096
"""Steps of the integral over the albedo table, which is smooth between nodes."""


@dataclass(frozen=True, eq=False)
class EnvironmentTables:
    """Precomputed tables of one environment map; see `kernels.render.lighting.environment.Lights`."""

    radiance: np.ndarray
    """(BACKGROUND_ROWS, 2 BACKGROUND_ROWS, 3) float32: the whole map, with the sun of its sIBL set drawn as a disc."""
    lampless: np.ndarray
    """(BACKGROUND_ROWS, 2 BACKGROUND_ROWS, 3) float32: the map without its lamps."""
    prefiltered: np.ndarray
    """(PREFILTER_LEVELS, PREFILTER_ROWS, 2 PREFILTER_ROWS, 3) float32: the map without its lamps, convolved with GGX lobes."""
    irradiance: np.ndarray
    """(9, 3) float32: coefficients of spherical harmonics."""
    lamps: list[environment.Lamp]
    """The sun of its sIBL set, if it is narrow, then others, the strongest first; see `scenes.environment`."""
    exposure: float
    """Factor that brings the map's radiance to display range."""


def sh_basis(directions: np.ndarray) -> np.ndarray:
    """The nine real spherical harmonics up to order 2 (..., 9) at unit directions (..., 3), in the order of `sh_irradiance`."""
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


def prefilter_specular(radiance: np.ndarray) -> np.ndarray:
    """Prefiltered specular map: the map convolved with GGX lobes, view direction = normal = reflection (split sum; Karis, 2013).
    `radiance`: (rows, 2 rows, 3). Returns (PREFILTER_LEVELS, rows, 2 rows, 3), for growing roughness."""
    rows = radiance.shape[0]
    directions, solid_angles = environment.map_directions(rows)
    incoming = directions.reshape(-1, 3)
    levels = []
    for level in range(int(PREFILTER_LEVELS)):
        alpha2 = ((level + 1.0) / int(PREFILTER_LEVELS)) ** 4
        # All columns of a row have the same lobe, rotated: one lobe per row, correlated along the columns by the Fourier transform.
        axes = directions[:, 0]
        cosine = matmul(axes, incoming.T)
        half2 = (1.0 + cosine) / 2.0
        lobe = np.where(cosine > 0.0, cosine * alpha2 / (half2 * (alpha2 - 1.0) + 1.0) ** 2, 0.0) * solid_angles.reshape(-1)
        lobe = (lobe / lobe.sum(axis=1, keepdims=True)).reshape(rows, rows, 2 * rows)
        spectrum = np.einsum("aij,ijc->ajc", np.conj(np.fft.fft(lobe, axis=2)), np.fft.fft(radiance, axis=1), optimize=True)
        levels.append(np.fft.ifft(spectrum, axis=1).real)
    return np.maximum(np.stack(levels), 0.0)


def separate_lamps(light: EnvironmentMap, max_lamps: int) -> tuple[np.ndarray, np.ndarray, list[environment.Lamp]]:
    """Split an environment map into its lamps and the rest.

    A sun that its sIBL set names is the first lamp, with the set's direction; a wide one is treated as any other light of the map. Returns
    the whole map (BACKGROUND_ROWS, 2 BACKGROUND_ROWS, 3), with the set's sun drawn as a disc; the map without its lamps; the lamps."""
    radiance = environment.resize_map(light.radiance, environment.BACKGROUND_ROWS)
    if light.sun is None:
        return radiance, *environment.extract_lamps(radiance, max_lamps, int(LAMP_POINTS))
    rest, direction, irradiance, radius = environment.replace_sun(radiance, light.sun)
    disc = environment.draw_sun_disc((rest < radiance).any(axis=2), direction, irradiance, radius)
    if radius > environment.MAX_SUN_TANGENT or max_lamps == 0:
        return rest + disc, *environment.extract_lamps(rest + disc, max_lamps, int(LAMP_POINTS))
    lampless, others = environment.extract_lamps(rest, max_lamps - 1, int(LAMP_POINTS), rest + disc)
    sun = environment.Lamp(direction, irradiance, radius, environment.sample_disc(direction, radius, int(LAMP_POINTS)))
    return rest + disc, lampless, [sun, *others]


def precompute_environment(light: EnvironmentMap, ground: np.ndarray | None, max_lamps: int = int(MAX_LAMPS)) -> EnvironmentTables:
    """Precompute the tables of one environment map. `light`: the map. `ground`: linear albedo (3) of the table, which replaces the map
    below the horizon in unoccluded lighting; None: no table. `max_lamps`: maximum number of lamps."""
    radiance, lampless, lamps = separate_lamps(light, max_lamps)
    directions, solid_angles = environment.map_directions(environment.BACKGROUND_ROWS)
    upward = np.maximum(directions[..., 2], 0.0) * solid_angles
    upward_irradiance = (radiance * upward[..., None]).sum(axis=(0, 1))
    # What unoccluded surfaces face: the table hides the map below the horizon.
    unoccluded = lampless if ground is None else np.where(directions[..., 2:] < 0.0, ground * upward_irradiance / np.pi, lampless)
    coefficients = np.einsum("ijk,ijc->kc", sh_basis(directions) * solid_angles[..., None], unoccluded) * COSINE_LOBE[:, None]
    white = max(float(dot(upward_irradiance, environment.LUMINANCE)) / np.pi, 1e-9)
    return EnvironmentTables(
        radiance=radiance.astype(np.float32),
        lampless=lampless.astype(np.float32),
        prefiltered=prefilter_specular(environment.resize_map(unoccluded, PREFILTER_ROWS)).astype(np.float32),
        irradiance=coefficients.astype(np.float32),
        lamps=lamps,
        exposure=environment.WHITE_VALUE / white,
    )


def environment_cdf(radiance: np.ndarray, table: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Marginal and conditional CDF of a map's texels, weighted by luminance times solid angle; uniform where the map is black.

    Light from near the horizon has less weight, because most lit surfaces face up and totes have walls. With a table, light from below the
    horizon has none, because the table blocks it.

    The map is looked up bilinearly, which spreads light half a texel beyond a lamp's edge. So a texel is weighted by the mean of the
    interpolated map over it: no direction with light has probability 0. `radiance`: (rows, 2 rows, 3). `table`: whether a table hides the
    map below the horizon. Returns marginal (rows + 1) and conditional (rows, 2 rows + 1), both float32."""
    rows, columns = radiance.shape[:2]
    directions, solid_angles = environment.map_directions(rows)
    height = directions[..., 2]
    importance = np.where(height > 0.0, height, 0.0) + HORIZON_WEIGHT
    if table:
        # The texels next to the horizon reach below it.
        importance[height < -np.pi / rows] = 0.0
    luminance = dot(radiance.astype(np.float64), environment.LUMINANCE)
    # Mean of the linear interpolation over a texel: 1/8, 3/4, 1/8.
    luminance = 0.75 * luminance + 0.125 * (np.roll(luminance, 1, axis=1) + np.roll(luminance, -1, axis=1))
    padded = np.pad(luminance, ((1, 1), (0, 0)), mode="edge")
    weight = (0.75 * luminance + 0.125 * (padded[:-2] + padded[2:])) * solid_angles * importance
    if weight.sum() <= 0.0:
        weight = solid_angles * importance
    conditional = np.zeros((rows, columns + 1))
    conditional[:, 1:] = np.cumsum(np.where(weight.sum(axis=1, keepdims=True) > 0.0, weight, 1.0), axis=1)
    marginal = np.concatenate([[0.0], np.cumsum(weight.sum(axis=1))])
    return (marginal / marginal[-1]).astype(np.float32), (conditional / conditional[:, -1:]).astype(np.float32)


def build_environment_cdf(radiance: np.ndarray, device: wp.Device, table: bool = False) -> Any:
    """The struct `EnvironmentCdf` of maps (map, rows, 2 rows, 3); `table`: whether a table hides them below the horizon."""
    marginals, conditionals = zip(*map_in_threads(lambda each: environment_cdf(each, table), radiance), strict=True)
    cdf = EnvironmentCdf()
    marginal, conditional = np.stack(marginals), np.stack(conditionals)
    cdf.marginal = wp.array(marginal, dtype=wp.float32, device=device)
    cdf.conditional = wp.array(conditional, dtype=wp.float32, device=device)
    cdf.marginal_guide = wp.array(guide_table(marginal), dtype=wp.uint16, device=device)
    cdf.conditional_guide = wp.array(guide_table(conditional), dtype=wp.uint16, device=device)
    return cdf


def guide_table(cdf: np.ndarray) -> np.ndarray:
    """Guide tables (Chen and Asau, 1974) of CDFs (..., n + 1): their inverses at u = 0, 1 / N, ... 1, (..., N + 1) uint16. N is the
    smallest power of two that is at least n, so that kernels compute the cell of a float32 without rounding."""
    entries = cdf.shape[-1] - 1
    cells = 1 << (entries - 1).bit_length()
    thresholds = np.arange(cells + 1) / cells
    found = [np.searchsorted(row, thresholds, side="right") - 1 for row in cdf.reshape(-1, entries + 1)]
    return np.minimum(found, entries - 1).astype(np.uint16).reshape(*cdf.shape[:-1], cells + 1)


def measure_albedo(device: wp.Device) -> Any:
    """The struct `AlbedoTables`: directional albedo of the GGX lobe, measured by Monte Carlo; cached per device."""
    return _measure_albedo(device.alias)


@functools.cache
def _measure_albedo(alias: str) -> Any:
    """Measure the albedo tables on a device, given by its alias: devices have no hash, so results are cached by alias."""
    device: wp.Device = wp.get_device(alias)
    tables = AlbedoTables()
    tables.directional = wp.empty((int(ALBEDO_ROWS), int(ALBEDO_COLUMNS)), dtype=wp.vec2, device=device)
    wp.launch(measure_albedo_kernel, dim=tables.directional.shape, outputs=[tables.directional], device=device)
    # With t = √μ, 2 ∫ a μ dμ = 4 ∫ a t³ dt, of the table as kernels interpolate it.
    directional = tables.directional.numpy().astype(np.float64)
    root = (np.arange(MEAN_STEPS) + 0.5) / MEAN_STEPS
    nodes = np.arange(directional.shape[1]) / (directional.shape[1] - 1)
    mean = [[4.0 * np.mean(np.interp(root, nodes, part) * root**3) for part in row.T] for row in directional]
    tables.mean = wp.array(mean, dtype=wp.vec2, device=device)
    return tables
