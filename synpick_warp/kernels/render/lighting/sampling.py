"""Sampling: Owen-scrambled Sobol' points, importance sampling of environment maps by marginal and conditional CDFs, orthonormal bases."""

import warp as wp

from synpick_warp.kernels.rng import GAMMA, UNIT, mix

wp.set_module_options({"enable_backward": False})


@wp.struct
class EnvironmentCdf:
    """CDFs over the texels of the environment maps with guide tables, for importance sampling (Pharr, Jakob and Humphreys, Physically Based
    Rendering).

    A texel's probability is the difference of neighbouring entries of `marginal` times that of `conditional`.
    """

    marginal: wp.array2d[float]
    """Over rows: (map, row + 1), from 0 to 1."""
    conditional: wp.array3d[float]
    """Over the columns of each row: (map, row, column + 1), from 0 to 1."""
    marginal_guide: wp.array2d[wp.uint16]
    """(map, cell + 1): guide table (Chen and Asau, 1974) of the marginal CDF: its inverse at u = cell / N, N a power of two."""
    conditional_guide: wp.array3d[wp.uint16]
    """(map, row, cell + 1): guide tables of the conditional CDFs."""


@wp.struct
class EnvironmentSample:
    """Direction sampled from the environment map for next-event estimation."""

    direction: wp.vec3
    """Unit vector, in the map's frame or in the world."""
    pdf: float
    """Probability density over solid angle [1/sr]."""
    radiance: wp.vec3
    """Radiance from this direction over its density, times its MIS weight; set by `paths.tracing.sample_direct_light`."""


@wp.func
def reverse_bits(x: wp.uint32) -> wp.uint32:
    """The 32 bits of `x` in reverse order."""
    y = (x >> wp.uint32(16)) | (x << wp.uint32(16))
    y = ((y >> wp.uint32(8)) & wp.uint32(0x00FF00FF)) | ((y & wp.uint32(0x00FF00FF)) << wp.uint32(8))
    y = ((y >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F)) | ((y & wp.uint32(0x0F0F0F0F)) << wp.uint32(4))
    y = ((y >> wp.uint32(2)) & wp.uint32(0x33333333)) | ((y & wp.uint32(0x33333333)) << wp.uint32(2))
    return ((y >> wp.uint32(1)) & wp.uint32(0x55555555)) | ((y & wp.uint32(0x55555555)) << wp.uint32(1))


@wp.func
def permute_laine_karras(x: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Laine-Karras permutation (2011) with Vegdahl's constants (2021): hash-based Owen scrambling of reversed bits. Each bit of the result
    depends on the bits below it alone."""
    y = x ^ (x * wp.uint32(0x3D20ADEA))
    y = y + seed
    y = y * ((seed >> wp.uint32(16)) | wp.uint32(1))
    y = y ^ (y * wp.uint32(0x05526C56))
    return y ^ (y * wp.uint32(0x53A22864))


@wp.func
def multiply_pascal(x: wp.uint32) -> wp.uint32:
    """Pascal's matrix modulo 2 times the bits of `x`: the second Sobol' dimension of index `x`, with its bits reversed (Ahmed, 2024)."""
    y = x ^ (x >> wp.uint32(16))
    y = y ^ ((y >> wp.uint32(8)) & wp.uint32(0x00FF00FF))
    y = y ^ ((y >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F))
    y = y ^ ((y >> wp.uint32(2)) & wp.uint32(0x33333333))
    return y ^ ((y >> wp.uint32(1)) & wp.uint32(0x55555555))


@wp.func
def sobol_point(index: int) -> wp.vec2:
    """Point of the two-dimensional Sobol' sequence in (0, 1)² (Sobol', 1967): aligned runs of 2^k indices are stratified."""
    x = reverse_bits(wp.uint32(index)) >> wp.uint32(8)
    y = reverse_bits(multiply_pascal(wp.uint32(index))) >> wp.uint32(8)
    return wp.vec2((float(x) + 0.5) * UNIT, (float(y) + 0.5) * UNIT)


@wp.func
def rotate_to_axis(axis: wp.vec3, local: wp.vec3) -> wp.vec3:
    """Transform `local` from a frame with z up into the orthonormal basis whose z is the unit vector `axis` (Duff et al., 2017)."""
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
    """Shuffled, Owen-scrambled Sobol' point `index` in [0, 1)² (Burley, 2020); each (key, dimension) has its own scrambling. Aligned runs
    of 2^k indices stay stratified; points of different dimensions or keys are uncorrelated."""
    bits = mix(key + wp.uint64(dimension + 1) * GAMMA)
    order = wp.uint32(bits)
    across = wp.uint32(bits >> wp.uint64(32))
    down = (across ^ (order << wp.uint32(15)) ^ (order >> wp.uint32(17))) * wp.uint32(0x31848BAB)
    # The shuffle is an Owen scrambling of the index, so that an aligned run of indices stays an aligned run.
    rest = reverse_bits(permute_laine_karras(reverse_bits(wp.uint32(index)), order))
    x = reverse_bits(permute_laine_karras(rest, across))
    y = reverse_bits(permute_laine_karras(multiply_pascal(rest), down))
    return wp.vec2(float(x >> wp.uint32(8)) * UNIT, float(y >> wp.uint32(8)) * UNIT)


@wp.func
def texel_pdf(cdf: EnvironmentCdf, light: int, row: int, column: int) -> float:
    """Probability density over solid angle of the directions in a texel [1/sr]."""
    rows = cdf.conditional.shape[1]
    columns = cdf.conditional.shape[2] - 1
    probability = cdf.marginal[light, row + 1] - cdf.marginal[light, row]
    probability *= cdf.conditional[light, row, column + 1] - cdf.conditional[light, row, column]
    # cos a - cos b without cancellation, times the texel's azimuth.
    band = 2.0 * wp.sin((float(row) + 0.5) / float(rows) * wp.PI) * wp.sin(0.5 / float(rows) * wp.PI)
    return probability * float(columns) / (band * wp.TAU)


@wp.func
def environment_pdf(cdf: EnvironmentCdf, light: int, direction: wp.vec3) -> float:
    """Probability density over solid angle with which `sample_environment` returns a unit direction in the map's frame [1/sr]."""
    rows = cdf.conditional.shape[1]
    columns = cdf.conditional.shape[2] - 1
    v = wp.acos(wp.clamp(direction[2], -1.0, 1.0)) / wp.PI
    u = wp.atan2(direction[1], direction[0]) / wp.TAU + 0.5
    row = wp.clamp(int(v * float(rows)), 0, rows - 1)
    column = wp.clamp(int(u * float(columns)), 0, columns - 1)
    return texel_pdf(cdf, light, row, column)


@wp.func
def invert_marginal(cdf: EnvironmentCdf, light: int, u: float) -> int:
    """Invert the marginal CDF by bisection between entries of its guide table: the row r with marginal[r] <= u < marginal[r + 1]."""
    cell = int(u * float(cdf.marginal_guide.shape[1] - 1))
    low = int(cdf.marginal_guide[light, cell])
    high = int(cdf.marginal_guide[light, cell + 1]) + 1
    while high - low > 1:
        middle = (low + high) // 2
        if cdf.marginal[light, middle] <= u:
            low = middle
        else:
            high = middle
    return low


@wp.func
def invert_conditional(cdf: EnvironmentCdf, light: int, row: int, u: float) -> int:
    """Invert a row's conditional CDF, as `invert_marginal`: the column c with conditional[c] <= u < conditional[c + 1]."""
    cell = int(u * float(cdf.conditional_guide.shape[2] - 1))
    low = int(cdf.conditional_guide[light, row, cell])
    high = int(cdf.conditional_guide[light, row, cell + 1]) + 1
    while high - low > 1:
        middle = (low + high) // 2
        if cdf.conditional[light, row, middle] <= u:
            low = middle
        else:
            high = middle
    return low


@wp.func
def sample_environment(cdf: EnvironmentCdf, light: int, u: wp.vec2) -> EnvironmentSample:
    """Sample a direction in proportion to the texels' weights (luminance times solid angle), uniformly within a texel. `u` is uniform in
    [0, 1)²; see `stages.render.light_tables.environment_cdf` for the weights."""
    rows = cdf.conditional.shape[1]
    columns = cdf.conditional.shape[2] - 1
    row = invert_marginal(cdf, light, u[0])
    column = invert_conditional(cdf, light, row, u[1])
    before = cdf.marginal[light, row]
    down = (u[0] - before) / (cdf.marginal[light, row + 1] - before)
    before = cdf.conditional[light, row, column]
    right = (u[1] - before) / (cdf.conditional[light, row, column + 1] - before)
    upper = wp.cos(float(row) / float(rows) * wp.PI)
    lower = wp.cos(float(row + 1) / float(rows) * wp.PI)
    z = upper + down * (lower - upper)
    radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    azimuth = ((float(column) + right) / float(columns) - 0.5) * wp.TAU
    sample = EnvironmentSample()
    sample.direction = wp.vec3(radius * wp.cos(azimuth), radius * wp.sin(azimuth), z)
    sample.pdf = texel_pdf(cdf, light, row, column)
    return sample
