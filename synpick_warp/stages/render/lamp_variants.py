"""Light randomization: variants of environment maps with lamps drawn into them, as distant discs of black-body colour."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from synpick_warp.codes import Look, LookPart
from synpick_warp.configs.episodes.randomize import OFF, Randomize
from synpick_warp.scenes.environment import LUMINANCE, draw_sun_disc, map_directions
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.render.looks import draw_parameters
from synpick_warp.system.linear_algebra import DECIMALS, dot

SUN_CLEARANCE = 25.0
"""Lamps keep this angle from a set's sun [°], which takes in what is bright about it; nearer ones go to the opposite azimuth."""
MAX_LAMPS = 4
# x of the Planckian locus by 1000 K / T, and y by x (Kim et al., 2002): upper end of the range, coefficients of descending powers.
_LOCUS_X = ((4000.0, (-0.2661239, -0.2343589, 0.8776956, 0.179910)), (25000.0, (-3.0258469, 2.1070379, 0.2226347, 0.240390)))
_LOCUS_Y = (
    (2222.0, (-1.1063814, -1.34811020, 2.18555832, -0.20219683)),
    (4000.0, (-0.9549476, -1.37418593, 2.09137015, -0.16748867)),
    (25000.0, (3.0817580, -5.87338670, 3.75112997, -0.37001483)),
)
_RGB_OF_XYZ = np.array([[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]])
"""Linear sRGB of CIE XYZ (IEC 61966-2-1)."""


def load_scene_lights(
    folder: str, randomize: Randomize, seed: int, report: Callable[[str], None], strict: bool = False
) -> tuple[EnvironmentMap, ...]:
    """Load the environment maps of a folder (`load_lights`); if lamps are randomized, `lamp_variants` variants of each with its lamps."""
    lights = load_lights(folder, report, strict)
    if randomize.lamps.kind == OFF:
        return lights
    looks = Looks(randomize, (), ())
    variants = randomize.lamp_variants
    return tuple(
        add_lamps(light, f"{light.name}+{variant}", looks, seed, index * variants + variant)
        for index, light in enumerate(lights)
        for variant in range(variants)
    )


def add_lamps(light: EnvironmentMap, name: str, looks: Looks, seed: int, variant: int) -> EnvironmentMap:
    """Draw lamps into an environment map, which gets a new name; `variant` is the index of the random draw."""
    _, drawn = draw_parameters(looks, seed, variant, [(LookPart.LAMP, index) for index in range(MAX_LAMPS)])
    directions, solid_angles = map_directions(light.radiance.shape[0])
    upward = np.maximum(directions[..., 2], 0.0) * solid_angles
    ambient = float(dot((light.radiance * upward[..., None]).sum(axis=(0, 1)), LUMINANCE))
    radiance = light.radiance.astype(np.float64)
    for values in drawn[: int(np.rint(drawn[0, Look.COUNT, 0])), :, 0].astype(np.float64):
        direction = lamp_direction(values[Look.AZIMUTH], values[Look.ELEVATION])
        if light.sun is not None and dot(direction, light.sun.direction) > np.cos(np.radians(SUN_CLEARANCE)).round(DECIMALS):
            direction = direction * (-1.0, -1.0, 1.0)
        irradiance = ambient * values[Look.STRENGTH] / direction[2] * black_body_color(values[Look.TEMPERATURE])
        tangent = round(float(np.tan(np.radians(values[Look.RADIUS]))), DECIMALS)
        radiance += draw_sun_disc(np.zeros(radiance.shape[:2], bool), direction, irradiance, tangent)
    return replace(light, name=name, radiance=radiance.astype(np.float32))


def lamp_direction(azimuth: float, elevation: float) -> np.ndarray:
    """Unit direction (3) of an azimuth and an elevation [°]."""
    turn, height = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)]).round(DECIMALS)


def black_body_color(temperature: float) -> np.ndarray:
    """Linear sRGB (3) of a black body of a temperature [K], 1,700 to 25,000, of luminance 1; components are at least 0. Cubic approximation
    of the Planckian locus (Kim et al., 2002)."""
    inverse = 1000.0 / temperature
    x = np.polyval(next(row for end, row in _LOCUS_X if temperature <= end), inverse)
    y = np.polyval(next(row for end, row in _LOCUS_Y if temperature <= end), x)
    color = np.maximum(dot(_RGB_OF_XYZ, np.array((x / y, 1.0, (1.0 - x - y) / y))), 0.0)
    return color / dot(color, LUMINANCE)
