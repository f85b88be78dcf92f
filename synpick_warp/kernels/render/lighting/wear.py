"""Procedural wear of surfaces (solid texturing: Perlin, SIGGRAPH 1985): scratches, rust, stains and dust over any mesh, by noise in the
body's own frame, so that it needs no texture coordinates and moves with the body."""

import warp as wp

wp.set_module_options({"enable_backward": False})

WEAR_LENGTH = wp.constant(0.06)
"""Unit of length of all wear [m]; of smaller bodies, the radius of their bounding sphere. A unit has RUST_SCALE cells of noise, and a cell
NOISE_CELL samples of the table."""
NOISE_SIZE, NOISE_CELL = wp.constant(64), wp.constant(8)
"""Samples of the noise table along each axis, and in a cell of the noise; it repeats after eight cells."""
NOISE_RANGE = wp.constant(0.95)
"""Largest value that the table can hold; the sums of two octaves reach 0.82."""
NOISE_TURN = wp.constant(wp.mat33(0.7351, -0.554, 0.3907, 0.6212, 0.3199, -0.7154, 0.2713, 0.7686, 0.5793))
"""Rotation of the table against the body, by Euler angles of 37, 23 and 51 degrees: no flat wall shows it repeat."""
FINE_SCALE = wp.constant(4.0)
"""Frequency of the second look-up of the table, whose two octaves follow those of the first, at a quarter of their amplitude."""
NOISE_SPREAD, STAIN_SPREAD = wp.constant(0.207), wp.constant(0.215)
"""Standard deviations of the noise of rust and of stains, measured at 400,000 places."""
LOGISTIC = wp.constant(0.5513)
"""Ratio of standard deviations, √3 / π: times it, the logistic quantile, log(p / (1 - p)), approximates the normal one's."""
EDGE = wp.constant(0.1)
"""Half width of a patch's soft edge, in noise values."""
RUST_SCALE, STAIN_SCALE = wp.constant(2.5), wp.constant(1.25)
"""Lowest frequencies of the noise of rust, and of stains: cells per unit."""
SCRATCH_NORMALS = wp.constant(wp.mat33(0.928, 0.0, -0.371, -0.737, 0.675, 0.0, 0.081, -0.925, 0.371))
"""A row for each direction of scratches: the normal of their sheets, each turned by the golden angle."""
SCRATCH_DENSITY = wp.constant(22.0)
"""Noise frequency across scratches [1/unit]."""
SCRATCH_SLOPE = wp.constant(0.5)
"""Mean slope of the noise at its zeros, by which a pixel's footprint becomes a range of noise values."""
SCRATCH_WIDTH, SCRATCH_BEND = wp.constant(0.06), wp.constant(0.03)
"""Half width of a scratch at amount 1, in noise values, and amplitude of its bending, in units of length."""
SCRATCH_END = wp.constant(0.25)
"""Noise value along a scratch at which it reaches full strength; it ends at 0."""
SCRATCH_BLUR = wp.constant(0.4)
"""Maximum blur of a scratch by the pixel footprint, in noise values: about the range of the noise, where scratches become uniform haze."""
DUST_CONTRAST, TONE_CONTRAST = wp.constant(0.7), wp.constant(1.5)
"""Gain of the noise in dust density and rust tone, about a mean of 0.5. These and the values below are chosen by eye."""
RUST_DARK, RUST_BRIGHT = wp.constant(wp.vec3(0.06, 0.016, 0.006)), wp.constant(wp.vec3(0.29, 0.085, 0.022))
"""Linear base colour of iron oxides, thick and thin."""
DUST_COLOR = wp.constant(wp.vec3(0.42, 0.37, 0.30))
"""Linear base colour of dust of packing and concrete."""
OIL_COLOR = wp.constant(wp.vec3(0.35, 0.27, 0.17))
"""Transmittance of a film of used oil."""
SCRATCH_WHITE, OIL_METALLIC = wp.constant(0.25), wp.constant(0.5)
"""Blend of a scratched base colour towards white, and factor of oil on metallic."""
RUST_ROUGHNESS, OIL_ROUGHNESS, DUST_ROUGHNESS, SCRATCH_ROUGHNESS = wp.constant(0.9), wp.constant(0.12), wp.constant(0.95), wp.constant(0.6)


MEAN_SHARE = wp.constant(wp.vec4(0.28, 1.0, 1.0, 0.5))
"""Mean of each share at amount 1; that of scratches was measured in pixels of 0.6 mm, at amounts from 0.1 to 1: 0.34 to 0.25."""
ONE_BITS = wp.constant(wp.uint32(0x3F800000))
"""Bits of the number 1 in float32."""


@wp.struct
class Wear:
    """Wear at one place: shares, 0 to 1, of scratches, rust, stains and dust, and the tone of the rust, 0 dark to 1 bright."""

    share: wp.vec4
    tone: float


@wp.struct
class Worn:
    """Linear base colour, metallic and perceptual roughness of a worn surface."""

    color: wp.vec3
    metallic: float
    roughness: float


@wp.func
def has_wear(amount: wp.vec4) -> bool:
    """Whether a surface has wear of any kind."""
    return amount[0] + amount[1] + amount[2] + amount[3] > 0.0


@wp.func
def fade_out(footprint: float) -> float:
    """Weight of noise with cells of length 1 in a pixel of this footprint: 0 from one pixel a cell on (frequency clamping)."""
    return wp.clamp(2.0 - 2.0 * footprint, 0.0, 1.0)


@wp.kernel
def make_noise_kernel(
    # Scene:
    seed: wp.uint32,
    # Out:
    noise_out: wp.array3d[wp.uint32],  # (x, y, z)
):
    """Bake the noise table: three periodic sums of two octaves of Perlin noise, for rust, stains and ends of scratches, in the bits 31 to
    21, 20 to 10 and 9 to 0; the second has cells twice as wide. Launched over its samples."""
    i, j, k = wp.tid()
    packed = wp.uint32(0)
    for channel in range(3):
        scale = wp.where(channel == 1, 0.5, 1.0) / float(NOISE_CELL)
        width = int(float(NOISE_SIZE) * scale)
        place = scale * wp.vec3(float(i), float(j), float(k))
        state = seed + wp.uint32(channel)
        value = wp.pnoise(state, place, width, width, width) + 0.5 * wp.pnoise(state, 2.0 * place, 2 * width, 2 * width, 2 * width)
        share = wp.clamp(0.5 + 0.5 * value / NOISE_RANGE, 0.0, 1.0)
        bits = wp.where(channel == 2, 10, 11)
        packed = (packed << wp.uint32(bits)) | wp.uint32(int(share * float((1 << bits) - 1) + 0.5))
    noise_out[i, j, k] = packed


@wp.func
def sample_noise(noise: wp.array3d[wp.uint32], place: wp.vec3) -> wp.vec3:
    """Trilinear look-up in the noise table, at a place in cells. A channel's bits are the mantissa of a number from 1 to 2."""
    at = float(NOISE_CELL) * place
    first = wp.vec3i(int(wp.floor(at[0])), int(wp.floor(at[1])), int(wp.floor(at[2])))
    total = wp.vec3(0.0, 0.0, 0.0)
    for corner in range(8):
        x, y, z = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = 1.0 - wp.abs(at[0] - float(first[0] + x))
        weight = weight * (1.0 - wp.abs(at[1] - float(first[1] + y))) * (1.0 - wp.abs(at[2] - float(first[2] + z)))
        bits = noise[(first[0] + x) & (NOISE_SIZE - 1), (first[1] + y) & (NOISE_SIZE - 1), (first[2] + z) & (NOISE_SIZE - 1)]
        total[0] += weight * wp.cast((bits >> wp.uint32(9)) | ONE_BITS, wp.float32)
        total[1] += weight * wp.cast(((bits << wp.uint32(11)) >> wp.uint32(9)) | ONE_BITS, wp.float32)
        total[2] += weight * wp.cast(((bits << wp.uint32(22)) >> wp.uint32(9)) | ONE_BITS, wp.float32)
    return 2.0 * NOISE_RANGE * (total - wp.vec3(1.5, 1.5, 1.5))


@wp.func
def patches(noise: float, spread: float, footprint: float, coverage: float) -> float:
    """Mask of patches, 0 to 1, that cover about this fraction of the surface: noise above a quantile; far away the fraction itself."""
    share = wp.clamp(coverage, 1.0e-3, 0.999)
    threshold = spread * LOGISTIC * wp.log((1.0 - share) / share)
    return wp.lerp(coverage, wp.smoothstep(threshold - EDGE, threshold + EDGE, noise), fade_out(footprint))


@wp.func
def scratches(state: wp.uint32, place: wp.vec3, footprint: float, amount: float, noise: wp.vec3) -> float:
    """Mask of scratches, 0 to 1: where sheets in space cut the surface, in a few directions. Sheets are zeros of noise along a normal,
    bent by the stains' noise, and end where their component of `noise` is low."""
    total = float(0.0)
    width = SCRATCH_WIDTH * amount
    blur = wp.min(SCRATCH_SLOPE * SCRATCH_DENSITY * footprint, SCRATCH_BLUR)
    for family in range(3):
        along = wp.dot(place, SCRATCH_NORMALS[family]) + SCRATCH_BEND * noise[1]
        level = wp.abs(wp.noise(state + wp.uint32(family), SCRATCH_DENSITY * along))
        if level < width + blur:
            # Blurred, a scratch is fainter by about as much as it is wider.
            present = wp.smoothstep(0.0, SCRATCH_END, noise[family])
            total += present * width / (width + 0.5 * blur) * (1.0 - wp.smoothstep(0.5 * width, width + blur, level))
    return wp.min(total, 1.0)


@wp.func
def mean_wear(amount: wp.vec4) -> Wear:
    """Wear on average over a surface."""
    result = Wear()
    result.share = wp.cw_mul(MEAN_SHARE, amount)
    result.tone = 0.5
    return result


@wp.func
def find_wear(noise: wp.array3d[wp.uint32], amount: wp.vec4, pattern: int, place: wp.vec3, footprint: float) -> Wear:
    """Wear at a place in the body's frame, for amounts, 0 to 1, of scratches, rust, stains and dust; `footprint` is the pixel's width on
    the surface, both in the unit of wear; `noise` is the table, `pattern` the seed of the part of it that the body shows."""
    result = Wear()
    state = wp.rand_init(pattern)
    shift = float(NOISE_SIZE // NOISE_CELL) * wp.vec3(wp.randf(state), wp.randf(state), wp.randf(state))
    cell = shift + RUST_SCALE * (NOISE_TURN * place)
    coarse = sample_noise(noise, cell)
    fine = float(0.0)
    fade = fade_out(FINE_SCALE * RUST_SCALE * footprint)
    # Only rust and dust use the fine octaves.
    if amount[1] + amount[3] > 0.0 and fade > 0.0:
        fine = fade * sample_noise(noise, FINE_SCALE * cell)[0]
    value = fade_out(RUST_SCALE * footprint) * coarse[0] + fine / FINE_SCALE
    share = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if amount[0] > 0.0:
        share[0] = scratches(state, place, footprint, amount[0], coarse)
    if amount[1] > 0.0:
        share[1] = patches(value, NOISE_SPREAD, RUST_SCALE * footprint, amount[1])
    if amount[2] > 0.0:
        share[2] = patches(coarse[1], STAIN_SPREAD, STAIN_SCALE * footprint, amount[2])
    # Dust lies where rust does not.
    share[3] = amount[3] * wp.clamp(0.5 - DUST_CONTRAST * value, 0.0, 1.0)
    result.share = share
    result.tone = wp.clamp(0.5 + TONE_CONTRAST * fine, 0.0, 1.0)
    return result


@wp.func
def apply_wear(wear: Wear, color: wp.vec3, metallic: float, roughness: float) -> Worn:
    """Change a material by its wear: scratches, rust, stains and dust, one over the other."""
    result = Worn()
    # Below a scratch lies bright metal, or paler plastic.
    result.color = wp.lerp(color, wp.vec3(1.0, 1.0, 1.0), SCRATCH_WHITE * wear.share[0])
    result.roughness = wp.lerp(roughness, wp.max(roughness, SCRATCH_ROUGHNESS), wear.share[0])
    # Plastic does not rust.
    rust = metallic * wear.share[1]
    # The metal's colour goes first: as one that scatters, it would be a pale rim.
    result.color = wp.lerp(result.color, wp.lerp(RUST_DARK, RUST_BRIGHT, wear.tone), wp.min(2.0 * rust, 1.0))
    result.roughness = wp.lerp(result.roughness, RUST_ROUGHNESS, rust)
    result.color = wp.lerp(result.color, wp.cw_mul(OIL_COLOR, result.color), wear.share[2])
    result.roughness = wp.lerp(result.roughness, OIL_ROUGHNESS, wear.share[2])
    result.color = wp.lerp(result.color, DUST_COLOR, wear.share[3])
    result.roughness = wp.lerp(result.roughness, DUST_ROUGHNESS, wear.share[3])
    result.metallic = metallic * (1.0 - rust) * (1.0 - (1.0 - OIL_METALLIC) * wear.share[2]) * (1.0 - wear.share[3])
    return result
