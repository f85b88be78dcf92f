"""Points and directions for estimating light: scrambled Sobol' points with an address, and directions drawn by a map's radiance."""

import warp as wp

from synpick_warp.kernels.rng import GAMMA, UNIT, mix

wp.set_module_options({"enable_backward": False})


@wp.struct
class Chances:
    """How likely each texel of each map is drawn. Cumulative: a texel's chance is the difference of two neighbours."""

    row: wp.array2d[float]
    """(map, row + 1), from 0 to 1."""
    column: wp.array3d[float]
    """(map, row, column + 1), from 0 to 1 in each row."""


@wp.struct
class LightSample:
    """A direction from which light may come."""

    direction: wp.vec3
    """Unit, in the map's frame."""
    density: float
    """Probability per solid angle [1/sr]."""
    radiance: wp.vec3
    """What comes from there, as `kernels.render.lighting.path_tracing` weights it."""


@wp.func
def reversed_bits(x: wp.uint32) -> wp.uint32:
    y = (x >> wp.uint32(16)) | (x << wp.uint32(16))
    y = ((y >> wp.uint32(8)) & wp.uint32(0x00FF00FF)) | ((y & wp.uint32(0x00FF00FF)) << wp.uint32(8))
    y = ((y >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F)) | ((y & wp.uint32(0x0F0F0F0F)) << wp.uint32(4))
    y = ((y >> wp.uint32(2)) & wp.uint32(0x33333333)) | ((y & wp.uint32(0x33333333)) << wp.uint32(2))
    return ((y >> wp.uint32(1)) & wp.uint32(0x55555555)) | ((y & wp.uint32(0x55555555)) << wp.uint32(1))


@wp.func
def carried(x: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Laine and Karras' permutation (2011), with Vegdahl's constants (2021): a bit depends on the bits below it alone."""
    y = x ^ (x * wp.uint32(0x3D20ADEA))
    y = y + seed
    y = y * ((seed >> wp.uint32(16)) | wp.uint32(1))
    y = y ^ (y * wp.uint32(0x05526C56))
    return y ^ (y * wp.uint32(0x53A22864))


@wp.func
def pascal(x: wp.uint32) -> wp.uint32:
    """Bits times Pascal's matrix, modulo 2: with its bits reversed, number `x` of the second dimension of Sobol' (Ahmed, 2024)."""
    y = x ^ (x >> wp.uint32(16))
    y = y ^ ((y >> wp.uint32(8)) & wp.uint32(0x00FF00FF))
    y = y ^ ((y >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F))
    y = y ^ ((y >> wp.uint32(2)) & wp.uint32(0x33333333))
    return y ^ ((y >> wp.uint32(1)) & wp.uint32(0x55555555))


@wp.func
def sobol_point(index: int) -> wp.vec2:
    """Point of the two-dimensional Sobol' sequence in (0, 1)²: aligned runs of 2^k points fill the unit square evenly (Sobol', 1967)."""
    x = reversed_bits(wp.uint32(index)) >> wp.uint32(8)
    y = reversed_bits(pascal(wp.uint32(index))) >> wp.uint32(8)
    return wp.vec2((float(x) + 0.5) * UNIT, (float(y) + 0.5) * UNIT)


@wp.func
def around(axis: wp.vec3, local: wp.vec3) -> wp.vec3:
    """`local`, carried from a frame with z up to one whose z is the unit vector `axis` (Duff et al., 2017)."""
    side = float(1.0)
    if axis[2] < 0.0:
        side = float(-1.0)
    a = -1.0 / (side + axis[2])
    b = axis[0] * axis[1] * a
    tangent = wp.vec3(1.0 + side * axis[0] * axis[0] * a, side * b, -side * axis[0])
    bitangent = wp.vec3(b, side + axis[1] * axis[1] * a, -axis[1])
    return local[0] * tangent + local[1] * bitangent + local[2] * axis


@wp.func
def scrambled_point(key: wp.uint64, index: int, dimension: int) -> wp.vec2:
    """Point `index` of the two-dimensional Sobol' sequence in [0, 1)², shuffled and Owen-scrambled anew for each (key, dimension).

    Any aligned run of 2^k indices fills the square evenly; points of different dimensions or keys are unrelated (Burley, 2020).
    """
    bits = mix(key + wp.uint64(dimension + 1) * GAMMA)
    order = wp.uint32(bits)
    across = wp.uint32(bits >> wp.uint64(32))
    down = (across ^ (order << wp.uint32(15)) ^ (order >> wp.uint32(17))) * wp.uint32(0x31848BAB)
    # Carried on the reversed index, as for the points: a run of indices stays a run.
    rest = reversed_bits(carried(reversed_bits(wp.uint32(index)), order))
    x = reversed_bits(carried(rest, across))
    y = reversed_bits(carried(pascal(rest), down))
    return wp.vec2(float(x >> wp.uint32(8)) * UNIT, float(y >> wp.uint32(8)) * UNIT)


@wp.func
def texel_density(chances: Chances, light: int, row: int, column: int) -> float:
    """Probability per solid angle of directions in a texel [1/sr]."""
    rows = chances.column.shape[1]
    columns = chances.column.shape[2] - 1
    chance = chances.row[light, row + 1] - chances.row[light, row]
    chance *= chances.column[light, row, column + 1] - chances.column[light, row, column]
    # cos a - cos b without cancellation, times the texel's azimuth.
    band = 2.0 * wp.sin((float(row) + 0.5) / float(rows) * wp.PI) * wp.sin(0.5 / float(rows) * wp.PI)
    return chance * float(columns) / (band * wp.TAU)


@wp.func
def light_density(chances: Chances, light: int, direction: wp.vec3) -> float:
    """Probability per solid angle with which `sample_light` gives a unit direction in the map's frame [1/sr]."""
    rows = chances.column.shape[1]
    columns = chances.column.shape[2] - 1
    v = wp.acos(wp.clamp(direction[2], -1.0, 1.0)) / wp.PI
    u = wp.atan2(direction[1], direction[0]) / wp.TAU + 0.5
    row = wp.clamp(int(v * float(rows)), 0, rows - 1)
    column = wp.clamp(int(u * float(columns)), 0, columns - 1)
    return texel_density(chances, light, row, column)


@wp.func
def find_row(chances: Chances, light: int, u: float) -> int:
    """Row r with row[r] <= u < row[r + 1]."""
    low = int(0)
    high = chances.row.shape[1] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if chances.row[light, middle] <= u:
            low = middle
        else:
            high = middle
    return low


@wp.func
def find_column(chances: Chances, light: int, row: int, u: float) -> int:
    """Column c with column[c] <= u < column[c + 1] in a row."""
    low = int(0)
    high = chances.column.shape[2] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if chances.column[light, row, middle] <= u:
            low = middle
        else:
            high = middle
    return low


@wp.func
def sample_light(chances: Chances, light: int, u: wp.vec2) -> LightSample:
    """A direction drawn by the map's luminance times solid angle, evenly within a texel, from two numbers in [0, 1)."""
    rows = chances.column.shape[1]
    columns = chances.column.shape[2] - 1
    row = find_row(chances, light, u[0])
    column = find_column(chances, light, row, u[1])
    before = chances.row[light, row]
    down = (u[0] - before) / (chances.row[light, row + 1] - before)
    before = chances.column[light, row, column]
    right = (u[1] - before) / (chances.column[light, row, column + 1] - before)
    upper = wp.cos(float(row) / float(rows) * wp.PI)
    lower = wp.cos(float(row + 1) / float(rows) * wp.PI)
    z = upper + down * (lower - upper)
    radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    azimuth = ((float(column) + right) / float(columns) - 0.5) * wp.TAU
    made = LightSample()
    made.direction = wp.vec3(radius * wp.cos(azimuth), radius * wp.sin(azimuth), z)
    made.density = texel_density(chances, light, row, column)
    return made
