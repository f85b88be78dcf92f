"""Procedural wear of surfaces (solid texturing: Perlin, SIGGRAPH 1985): scratches, rust, stains and dust over any mesh, by noise in the
body's own frame, so that it needs no texture coordinates and moves with the body."""

import warp as wp

wp.set_module_options({"enable_backward": False})

WEAR_LENGTH = wp.constant(0.06)
"""Unit of length of all wear [m]; of smaller bodies, the radius of their bounding sphere."""
OCTAVES, STAIN_OCTAVES = wp.constant(4), wp.constant(2)
"""Octaves of the noise of rust and dust, and of stains, each of half the amplitude and twice the frequency of the one before."""
NOISE_SPREAD, STAIN_SPREAD = wp.constant(0.22), wp.constant(0.21)
"""Standard deviations of their sums, measured at 400,000 places."""
LOGISTIC = wp.constant(0.5513)
"""Ratio of standard deviations, √3 / π: times it, the quantile of the logistic distribution, log(p / (1 - p)), approximates the normal
one's."""
EDGE = wp.constant(0.1)
"""Half width of a patch's soft edge, in noise values."""
RUST_SCALE, STAIN_SCALE, SCRATCH_SCALE = wp.constant(2.5), wp.constant(1.2), wp.constant(2.5)
"""Lowest frequencies of the noise: cells per unit; of scratches, along them."""
SCRATCH_FAMILIES = wp.constant(3)
"""Number of scratch directions."""
SCRATCH_TURN, SCRATCH_RISE = wp.constant(2.4), wp.constant(0.4)
"""The normal of scratch family k has azimuth k SCRATCH_TURN [rad], a multiple of the golden angle, and height (k - 1) SCRATCH_RISE."""
SCRATCH_DENSITY = wp.constant(22.0)
"""Noise frequency across scratches [1/unit]."""
SCRATCH_WIDTH, SCRATCH_BEND = wp.constant(0.06), wp.constant(0.03)
"""Half width of a scratch at amount 1, in noise values, and amplitude of its bending, in units of length."""
SCRATCH_END = wp.constant(0.25)
"""Noise value along a scratch at which it reaches full strength; it ends at 0."""
SCRATCH_BLUR = wp.constant(0.4)
"""Maximum blur of a scratch by the pixel footprint, in noise values: about the range of the noise, where scratches become uniform haze."""
DUST_CONTRAST, TONE_CONTRAST = wp.constant(0.7), wp.constant(4.0)
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


@wp.func
def fractal_noise(state: wp.uint32, place: wp.vec3, footprint: float, octaves: int) -> wp.vec2:
    """Fractal sum of Perlin noise about 0, and the part of it without the first octave; those finer than the pixel fade out."""
    first = fade_out(footprint) * wp.noise(state, place)
    fine = float(0.0)
    scale = float(2.0)
    for _octave in range(1, octaves):
        fade = fade_out(footprint * scale)
        if fade > 0.0:
            fine += fade / scale * wp.noise(state, scale * place)
        scale = 2.0 * scale
    return wp.vec2(first + fine, fine)


@wp.func
def patches(noise: float, spread: float, footprint: float, coverage: float) -> float:
    """Mask of patches, 0 to 1, that cover about this fraction of the surface: noise above a quantile; far away the fraction itself."""
    share = wp.clamp(coverage, 1.0e-3, 0.999)
    threshold = spread * LOGISTIC * wp.log((1.0 - share) / share)
    return wp.lerp(coverage, wp.smoothstep(threshold - EDGE, threshold + EDGE, noise), fade_out(footprint))


@wp.func
def scratches(state: wp.uint32, place: wp.vec3, footprint: float, amount: float, bend: float) -> float:
    """Mask of scratches, 0 to 1: where sheets in space cut the surface, in a few directions. Sheets are zeros of noise along a normal,
    bent by `bend`, and end where another noise is low."""
    total = float(0.0)
    width = SCRATCH_WIDTH * amount
    blur = wp.min(SCRATCH_DENSITY * footprint, SCRATCH_BLUR)
    for family in range(SCRATCH_FAMILIES):
        own = state + wp.uint32(8 + family)
        turn = SCRATCH_TURN * float(family)
        normal = wp.normalize(wp.vec3(wp.cos(turn), wp.sin(turn), SCRATCH_RISE * float(family - 1)))
        level = wp.abs(wp.noise(own, SCRATCH_DENSITY * (wp.dot(place, normal) + bend)))
        if level < width + blur:
            # Blurred, a scratch is fainter by about as much as it is wider.
            present = wp.smoothstep(0.0, SCRATCH_END, wp.noise(own, SCRATCH_SCALE * place))
            total += present * width / (width + 0.5 * blur) * (1.0 - wp.smoothstep(0.5 * width, width + blur, level))
    return wp.min(total, 1.0)


@wp.func
def find_wear(amount: wp.vec4, pattern: int, place: wp.vec3, footprint: float) -> Wear:
    """Wear at a place in the body's frame, for amounts, 0 to 1, of scratches, rust, stains and dust; `footprint` is the pixel's width on
    the surface, both in the unit of wear; `pattern` is the seed of the noise."""
    result = Wear()
    state = wp.rand_init(pattern)
    noise = fractal_noise(state, RUST_SCALE * place, RUST_SCALE * footprint, OCTAVES)
    share = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if amount[0] > 0.0:
        share[0] = scratches(state, place, footprint, amount[0], SCRATCH_BEND * (noise[0] - noise[1]))
    if amount[1] > 0.0:
        share[1] = patches(noise[0], NOISE_SPREAD, RUST_SCALE * footprint, amount[1])
    if amount[2] > 0.0:
        stain = fractal_noise(state + wp.uint32(1), STAIN_SCALE * place, STAIN_SCALE * footprint, STAIN_OCTAVES)
        share[2] = patches(stain[0], STAIN_SPREAD, STAIN_SCALE * footprint, amount[2])
    # Dust lies where rust does not.
    share[3] = amount[3] * wp.clamp(0.5 - DUST_CONTRAST * noise[0], 0.0, 1.0)
    result.share = share
    result.tone = wp.clamp(0.5 + TONE_CONTRAST * noise[1], 0.0, 1.0)
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
    result.color = wp.lerp(result.color, wp.lerp(RUST_DARK, RUST_BRIGHT, wear.tone), rust)
    result.roughness = wp.lerp(result.roughness, RUST_ROUGHNESS, rust)
    result.color = wp.lerp(result.color, wp.cw_mul(OIL_COLOR, result.color), wear.share[2])
    result.roughness = wp.lerp(result.roughness, OIL_ROUGHNESS, wear.share[2])
    result.color = wp.lerp(result.color, DUST_COLOR, wear.share[3])
    result.roughness = wp.lerp(result.roughness, DUST_ROUGHNESS, wear.share[3])
    result.metallic = metallic * (1.0 - rust) * (1.0 - (1.0 - OIL_METALLIC) * wear.share[2]) * (1.0 - wear.share[3])
    return result
