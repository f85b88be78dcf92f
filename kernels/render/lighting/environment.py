"""Light from the environment: directions, background, diffuse irradiance, blurred reflections."""

import warp as wp

wp.set_module_options({"enable_backward": False})

REFLECTION_LEVELS = wp.constant(5)
"""Reflections are blurred for roughness 1/5, 2/5, ... 1."""


FLAT_HARMONIC = wp.constant(0.282095)
"""The real spherical harmonic of order 0: 1 / (2 √π)."""


@wp.struct
class Lights:
    """Constant, one row a light map. Directions are the map's; a world turns them about +z."""

    maps: int
    background: wp.array3d[wp.vec3]
    """Radiance (map, row, column), first of all maps whole, then of all without their main light; row 0 looks up, column
    u = azimuth / 2π + 0.5."""
    reflection: wp.array4d[wp.vec3]
    """Radiance without the main light, blurred for growing roughness (map, level, row, column)."""
    irradiance: wp.array2d[wp.vec3]
    """Irradiance without the main light: nine coefficients of real spherical harmonics, already convolved with the cosine."""
    main_direction: wp.array[wp.vec3]
    """Unit vector towards the main light."""
    main_irradiance: wp.array[wp.vec3]
    """Irradiance of the main light on a surface that faces it; zero: the map has none."""
    main_spread: wp.array[float]
    """Tangent of the main light's angular radius."""
    exposure: wp.array[float]
    """Factor that brings the map's radiance to display range."""


@wp.func
def turned(direction: wp.vec3, angle: float) -> wp.vec3:
    """`direction`, turned counter-clockwise about +z [rad]."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec3(c * direction[0] - s * direction[1], s * direction[0] + c * direction[1], direction[2])


@wp.func
def map_position(direction: wp.vec3, rows: int, columns: int) -> wp.vec2:
    """(row, column) of a unit direction in an equirectangular map, in texels from the centre of the first."""
    u = wp.atan2(direction[1], direction[0]) / wp.TAU + 0.5
    v = wp.acos(wp.clamp(direction[2], -1.0, 1.0)) / wp.PI
    return wp.vec2(v * float(rows) - 0.5, u * float(columns) - 0.5)


@wp.struct
class Corners:
    """Where a bilinear look-up reads, and how far it lies from the upper left of the four texels."""

    upper: int
    lower: int
    west: int
    east: int
    down: float
    right: float


@wp.func
def map_corners(direction: wp.vec3, rows: int, columns: int) -> Corners:
    """The texels about a unit direction in an equirectangular map, whose left edge continues its right one."""
    at = map_position(direction, rows, columns)
    row = int(wp.floor(at[0]))
    column = int(wp.floor(at[1]))
    made = Corners()
    made.down = at[0] - float(row)
    made.right = at[1] - float(column)
    made.upper = wp.clamp(row, 0, rows - 1)
    made.lower = wp.clamp(row + 1, 0, rows - 1)
    # -1 is the last column, as `columns` is the first.
    made.west = wp.where(column < 0, columns - 1, column)
    made.east = wp.where(column + 1 == columns, 0, column + 1)
    return made


@wp.func
def bilinear(at: Corners, upper_west: wp.vec3, upper_east: wp.vec3, lower_west: wp.vec3, lower_east: wp.vec3) -> wp.vec3:
    return wp.lerp(wp.lerp(upper_west, upper_east, at.right), wp.lerp(lower_west, lower_east, at.right), at.down)


@wp.func
def background_radiance(lights: Lights, light: int, direction: wp.vec3) -> wp.vec3:
    """Radiance from a unit direction in the map's frame, bilinear."""
    at = map_corners(direction, lights.background.shape[1], lights.background.shape[2])
    return bilinear(
        at,
        lights.background[light, at.upper, at.west],
        lights.background[light, at.upper, at.east],
        lights.background[light, at.lower, at.west],
        lights.background[light, at.lower, at.east],
    )


@wp.func
def reflection_texel(lights: Lights, light: int, level: int, at: Corners) -> wp.vec3:
    """One level of the blurred reflections, bilinear."""
    return bilinear(
        at,
        lights.reflection[light, level, at.upper, at.west],
        lights.reflection[light, level, at.upper, at.east],
        lights.reflection[light, level, at.lower, at.west],
        lights.reflection[light, level, at.lower, at.east],
    )


@wp.func
def reflected_radiance(lights: Lights, light: int, direction: wp.vec3, roughness: float) -> wp.vec3:
    """Mean radiance of the reflection lobe of a rough surface about a unit direction in the map's frame."""
    level = wp.clamp(roughness * float(REFLECTION_LEVELS) - 1.0, 0.0, float(REFLECTION_LEVELS - 1))
    lower = wp.min(int(level), REFLECTION_LEVELS - 2)
    at = map_corners(direction, lights.reflection.shape[2], lights.reflection.shape[3])
    return wp.lerp(
        reflection_texel(lights, light, lower, at),
        reflection_texel(lights, light, lower + 1, at),
        level - float(lower),
    )


@wp.func
def diffuse_irradiance(lights: Lights, light: int, normal: wp.vec3) -> wp.vec3:
    """Irradiance on a surface with a unit normal in the map's frame, without the main light.

    Sum of nine real spherical harmonics (Ramamoorthi and Hanrahan, 2001); never negative.
    """
    x = normal[0]
    y = normal[1]
    z = normal[2]
    total = (
        lights.irradiance[light, 0] * FLAT_HARMONIC
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
