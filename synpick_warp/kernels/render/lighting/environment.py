"""Environment lighting: radiance maps (equirectangular), irradiance by spherical harmonics, prefiltered specular maps, lamps."""

import warp as wp

from synpick_warp.kernels.render.lighting.color import unpack_half3
from synpick_warp.kernels.render.visibility.camera import clamp_index
from synpick_warp.kernels.render.visibility.records import read_record

wp.set_module_options({"enable_backward": False})

MAX_LAMPS = wp.constant(8)
"""Maximum number of lamps of a map, and of shadow rays from a pixel of the shadow grid, which stores a bit for each."""
PREFILTER_LEVELS = wp.constant(5)
"""Levels of the prefiltered specular map, for roughness 1/5, 2/5, ... 1."""
SH_CONSTANT = wp.constant(0.282095)
"""Real spherical harmonic of order 0: 1 / (2 √π)."""


@wp.struct
class Lights:
    """Environment maps with and without their lamps. Constant."""

    maps: int
    radiance: wp.array3d[wp.vec4]
    """(2 maps, row, column): first every map as it is, then every map without its lamps. Row 0 is the zenith, column
    u = azimuth / 2π + 0.5. The fourth component is padding, so that `read_record` applies."""
    prefiltered: wp.array4d[wp.uint64]
    """(map, level, row, column): radiance without the lamps, convolved with GGX lobes of increasing roughness; times the map's exposure,
    and packed as by `pack_half3`."""
    irradiance: wp.array2d[wp.vec3]
    """(map, coefficient): irradiance without the lamps as nine real spherical harmonics, already convolved with the cosine."""
    lamps: wp.array[int]
    """(map): number of lamps, at most MAX_LAMPS."""
    lamp: wp.array3d[wp.vec4]
    """(map, lamp, 2): unit vector towards the lamp's center and tangent of its angular radius; irradiance on a surface that faces it, and
    its share in that of a surface that faces up."""
    lamp_point: wp.array3d[wp.vec3]
    """(map, lamp, point): unit vectors towards parts of the lamp of equal irradiance; see `scenes.environment.stratify_light`."""
    lamp_rays: wp.array[int]
    """(map): shadow rays to each lamp from a pixel of the shadow grid, a power of two; with all lamps at most MAX_LAMPS."""
    total_lamp_irradiance: wp.array[wp.vec3]
    """(map): sum of the lamps' irradiances; zero: the map has no lamps."""
    exposure: wp.array[float]
    """(map): factor that brings the map's radiance to display range."""


@wp.func
def unit_heading(angle: float) -> wp.vec2:
    """Unit vector (cos, sin) of an angle [rad]."""
    return wp.vec2(wp.cos(angle), wp.sin(angle))


@wp.func
def rotate_heading(direction: wp.vec3, heading: wp.vec2) -> wp.vec3:
    """`direction`, rotated counter-clockwise about +z by the angle of a `unit_heading`."""
    x = heading[0] * direction[0] - heading[1] * direction[1]
    y = heading[1] * direction[0] + heading[0] * direction[1]
    return wp.vec3(x, y, direction[2])


@wp.func
def rotate_z(direction: wp.vec3, angle: float) -> wp.vec3:
    """`direction`, rotated counter-clockwise about +z by `angle` [rad]."""
    return rotate_heading(direction, unit_heading(angle))


@wp.func
def lamp_center(lights: Lights, light: int, lamp: int) -> wp.vec4:
    """Unit vector towards a lamp's center, in the map's frame, and the tangent of its angular radius."""
    return read_record(lights.lamp, 2 * (light * MAX_LAMPS + lamp))


@wp.func
def lamp_irradiance(lights: Lights, light: int, lamp: int) -> wp.vec3:
    """Irradiance of a lamp on a surface that faces it."""
    record = read_record(lights.lamp, 2 * (light * MAX_LAMPS + lamp) + 1)
    return wp.vec3(record[0], record[1], record[2])


@wp.func
def lamp_share(lights: Lights, light: int, lamp: int) -> float:
    """Share of a lamp in the irradiance of an open surface that faces up, without occlusion."""
    return read_record(lights.lamp, 2 * (light * MAX_LAMPS + lamp) + 1)[3]


@wp.func
def lamp_direction(lights: Lights, light: int, lamp: int, heading: wp.vec2) -> wp.vec3:
    """Unit vector towards a lamp's center, in the world; `heading` is the `unit_heading` of the map's yaw."""
    center = lamp_center(lights, light, lamp)
    return rotate_heading(wp.vec3(center[0], center[1], center[2]), heading)


@wp.func
def map_coordinates(direction: wp.vec3, rows: int, columns: int) -> wp.vec2:
    """(row, column) of a unit direction in an equirectangular map, in texels from the centre of the first one."""
    u = wp.atan2(direction[1], direction[0]) / wp.TAU + 0.5
    v = wp.acos(wp.clamp(direction[2], -1.0, 1.0)) / wp.PI
    return wp.vec2(v * float(rows) - 0.5, u * float(columns) - 0.5)


@wp.struct
class BilinearTaps:
    """Rows and columns of the four texels of a bilinear look-up, and its position from the upper left one [texels]."""

    upper: int
    lower: int
    west: int
    east: int
    down: float
    right: float


@wp.func
def find_taps(direction: wp.vec3, rows: int, columns: int) -> BilinearTaps:
    """Texels to interpolate for a unit direction in an equirectangular map; columns wrap around, rows are clamped."""
    at = map_coordinates(direction, rows, columns)
    row = int(wp.floor(at[0]))
    column = int(wp.floor(at[1]))
    taps = BilinearTaps()
    taps.down = at[0] - float(row)
    taps.right = at[1] - float(column)
    taps.upper = clamp_index(row, rows)
    taps.lower = clamp_index(row + 1, rows)
    # -1 is the last column, as `columns` is the first.
    taps.west = wp.where(column < 0, columns - 1, column)
    taps.east = wp.where(column + 1 == columns, 0, column + 1)
    return taps


@wp.func
def bilinear(taps: BilinearTaps, upper_west: wp.vec3, upper_east: wp.vec3, lower_west: wp.vec3, lower_east: wp.vec3) -> wp.vec3:
    """Bilinear interpolation of four texels at the position of `taps`."""
    return wp.lerp(wp.lerp(upper_west, upper_east, taps.right), wp.lerp(lower_west, lower_east, taps.right), taps.down)


@wp.func
def read_texel(lights: Lights, index: int) -> wp.vec3:
    """Radiance of the texel at a row-major index of `Lights.radiance`."""
    texel = read_record(lights.radiance, index)
    return wp.vec3(texel[0], texel[1], texel[2])


@wp.func
def environment_radiance(lights: Lights, light: int, direction: wp.vec3) -> wp.vec3:
    """Radiance from a unit direction in the map's frame, bilinear. `light` is a row of `Lights.radiance`: the index of a map, or that plus
    `maps` for the map without its lamps."""
    rows = lights.radiance.shape[1]
    columns = lights.radiance.shape[2]
    taps = find_taps(direction, rows, columns)
    upper = (light * rows + taps.upper) * columns
    lower = (light * rows + taps.lower) * columns
    return bilinear(
        taps,
        read_texel(lights, upper + taps.west),
        read_texel(lights, upper + taps.east),
        read_texel(lights, lower + taps.west),
        read_texel(lights, lower + taps.east),
    )


@wp.func
def prefiltered_level(lights: Lights, light: int, level: int, taps: BilinearTaps) -> wp.vec3:
    """Bilinear look-up in one level of the prefiltered specular map; pre-exposed, see `CoarseLight`."""
    return bilinear(
        taps,
        unpack_half3(lights.prefiltered[light, level, taps.upper, taps.west]),
        unpack_half3(lights.prefiltered[light, level, taps.upper, taps.east]),
        unpack_half3(lights.prefiltered[light, level, taps.lower, taps.west]),
        unpack_half3(lights.prefiltered[light, level, taps.lower, taps.east]),
    )


@wp.func
def prefiltered_radiance(lights: Lights, light: int, direction: wp.vec3, roughness: float) -> wp.vec3:
    """Prefiltered specular radiance without the lamps (Karis, 2013), trilinear: the GGX lobe's mean about a unit direction of the map."""
    level = wp.clamp(roughness * float(PREFILTER_LEVELS) - 1.0, 0.0, float(PREFILTER_LEVELS - 1))
    lower = clamp_index(int(level), PREFILTER_LEVELS - 1)
    taps = find_taps(direction, lights.prefiltered.shape[2], lights.prefiltered.shape[3])
    exposed = wp.lerp(
        prefiltered_level(lights, light, lower, taps),
        prefiltered_level(lights, light, lower + 1, taps),
        level - float(lower),
    )
    return exposed / lights.exposure[light]


@wp.func
def sh_irradiance(lights: Lights, light: int, normal: wp.vec3) -> wp.vec3:
    """Irradiance by spherical harmonics of order 2 (Ramamoorthi and Hanrahan, 2001), without the lamps; clamped at zero. `normal` is a unit
    vector in the map's frame."""
    x = normal[0]
    y = normal[1]
    z = normal[2]
    total = (
        lights.irradiance[light, 0] * SH_CONSTANT
        + lights.irradiance[light, 1] * (0.488603 * y)
        + lights.irradiance[light, 2] * (0.488603 * z)
        + lights.irradiance[light, 3] * (0.488603 * x)
        + lights.irradiance[light, 4] * (1.092548 * x * y)
        + lights.irradiance[light, 5] * (1.092548 * y * z)
        + lights.irradiance[light, 6] * (0.315392 * (3.0 * z * z - 1.0))
        + lights.irradiance[light, 7] * (1.092548 * x * z)
        + lights.irradiance[light, 8] * (0.546274 * (x * x - y * y))
    )
    return wp.vec3(wp.max(total[0], 0.0), wp.max(total[1], 0.0), wp.max(total[2], 0.0))
