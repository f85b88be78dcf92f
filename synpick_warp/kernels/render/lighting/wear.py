"""Procedural wear of surfaces (solid texturing: Perlin, SIGGRAPH 1985): scratches, rust, stains and dust over any mesh, by noise in the
body's own frame, so that it needs no texture coordinates and moves with the body."""

import warp as wp

wp.set_module_options({"enable_backward": False})

OCTAVES = wp.constant(5)
"""Octaves of noise, each of half the amplitude and twice the frequency."""
NOISE_SPREAD = wp.constant(0.22)
"""Standard deviation of the sum of the octaves: measured at 400,000 places."""
LOGISTIC = wp.constant(0.5513)
"""Quantile of the normal distribution by that of the logistic one, √3 / π."""
EDGE = wp.constant(0.1)
"""Half width of the border of a patch, in units of the noise."""
RUST_SCALE, STAIN_SCALE, DUST_SCALE = wp.constant(2.5), wp.constant(1.2), wp.constant(4.0)
"""Lowest frequency of the noise: cells per radius of the body's bounding sphere."""
SCRATCH_FAMILIES = wp.constant(5)
"""Directions of scratches."""
SCRATCH_DENSITY, SCRATCH_SCALE = wp.constant(22.0), wp.constant(2.5)
"""Frequency of their noise across and along them, per radius of the body's bounding sphere."""
SCRATCH_WIDTH, SCRATCH_BEND = wp.constant(0.04), wp.constant(0.06)
"""Half width of a scratch where there are most, in units of the noise; and by how much scratches are bent, in radii."""
RUST_DARK, RUST_BRIGHT = wp.constant(wp.vec3(0.06, 0.016, 0.006)), wp.constant(wp.vec3(0.29, 0.085, 0.022))
"""Linear base colour of iron oxides, thick and thin."""
DUST_COLOR = wp.constant(wp.vec3(0.42, 0.37, 0.30))
"""Linear base colour of dust of packing and concrete."""
OIL_COLOR = wp.constant(wp.vec3(0.35, 0.27, 0.17))
"""Transmission of a film of used oil."""
RUST_ROUGHNESS, OIL_ROUGHNESS, DUST_ROUGHNESS, SCRATCH_ROUGHNESS = wp.constant(0.9), wp.constant(0.12), wp.constant(0.95), wp.constant(0.6)


SCRATCH_BLUR = wp.constant(0.4)
"""Largest blur of a scratch by a pixel's width, in units of the noise: about its range, at which scratches are an even haze."""


@wp.struct
class Worn:
    """Linear base colour, metallic and perceptual roughness of a worn surface."""

    color: wp.vec3
    metallic: float
    roughness: float


@wp.func
def fractal_noise(state: wp.uint32, place: wp.vec3, footprint: float) -> float:
    """Fractal sum of Perlin noise about 0; octaves finer than the pixel's `footprint` fade out (frequency clamping)."""
    total = float(0.0)
    scale = float(1.0)
    for _octave in range(OCTAVES):
        fade = wp.clamp(2.0 - 2.0 * footprint * scale, 0.0, 1.0)
        total += fade / scale * wp.noise(state, scale * place)
        scale = 2.0 * scale
    return total


@wp.func
def patches(state: wp.uint32, place: wp.vec3, footprint: float, coverage: float) -> float:
    """Mask of patches, 0 to 1, that cover about this fraction of the surface: noise above a quantile."""
    share = wp.clamp(coverage, 1.0e-3, 0.999)
    threshold = NOISE_SPREAD * LOGISTIC * wp.log((1.0 - share) / share)
    return wp.smoothstep(threshold - EDGE, threshold + EDGE, fractal_noise(state, place, footprint))


@wp.func
def scratches(state: wp.uint32, place: wp.vec3, footprint: float, amount: float) -> float:
    """Mask of scratches, 0 to 1: where sheets in space cut the surface, in a few directions. Sheets are zeros of noise along a normal,
    slightly bent, and end where another noise is low."""
    total = float(0.0)
    width = SCRATCH_WIDTH * amount
    blur = wp.min(SCRATCH_DENSITY * footprint, SCRATCH_BLUR)
    bend = SCRATCH_BEND * wp.noise(state, 1.5 * place)
    for family in range(SCRATCH_FAMILIES):
        own = state + wp.uint32(8 + family)
        turn = 2.4 * float(family) + 0.7
        height = float(family) / float(SCRATCH_FAMILIES) - 0.4
        normal = wp.vec3(wp.cos(turn), wp.sin(turn), height)
        distance = wp.abs(wp.noise(own, SCRATCH_DENSITY * (wp.dot(place, normal) + bend)))
        present = wp.smoothstep(0.0, 0.25, wp.noise(own, SCRATCH_SCALE * place))
        total += present * width / (width + 0.5 * blur) * (1.0 - wp.smoothstep(0.5 * width, width + blur, distance))
    return wp.min(total, 1.0)


@wp.func
def wear_out(wear: wp.vec4, pattern: int, place: wp.vec3, footprint: float, color: wp.vec3, metallic: float, roughness: float) -> Worn:
    """Change a material by its wear: amounts, 0 to 1, of scratches, rust, stains and dust, one over the other.

    `place` is the position in the body's frame and `footprint` the pixel's width on the surface, both in radii of its bounding sphere;
    `pattern` is the seed of the noise.
    """
    result = Worn()
    result.color = color
    result.metallic = metallic
    result.roughness = roughness
    state = wp.rand_init(pattern)
    if wear[0] > 0.0:
        share = scratches(state, place, footprint, wear[0])
        # What lies below: bright metal, or paler plastic.
        result.color = wp.lerp(result.color, 0.75 * result.color + wp.vec3(0.25, 0.25, 0.25), share)
        result.roughness = wp.lerp(result.roughness, wp.max(result.roughness, SCRATCH_ROUGHNESS), share)
    if wear[1] > 0.0:
        # Plastic does not rust.
        share = result.metallic * patches(state + wp.uint32(4), RUST_SCALE * place, RUST_SCALE * footprint, wear[1])
        tone = wp.clamp(0.5 + fractal_noise(state + wp.uint32(5), 3.0 * RUST_SCALE * place, 3.0 * RUST_SCALE * footprint), 0.0, 1.0)
        result.color = wp.lerp(result.color, wp.lerp(RUST_DARK, RUST_BRIGHT, tone), share)
        result.metallic = wp.lerp(result.metallic, 0.0, share)
        result.roughness = wp.lerp(result.roughness, RUST_ROUGHNESS, share)
    if wear[2] > 0.0:
        share = patches(state + wp.uint32(6), STAIN_SCALE * place, STAIN_SCALE * footprint, wear[2])
        result.color = wp.lerp(result.color, wp.cw_mul(OIL_COLOR, result.color), share)
        result.metallic = wp.lerp(result.metallic, 0.5 * result.metallic, share)
        result.roughness = wp.lerp(result.roughness, OIL_ROUGHNESS, share)
    if wear[3] > 0.0:
        grain = 0.5 + 1.2 * fractal_noise(state + wp.uint32(7), DUST_SCALE * place, DUST_SCALE * footprint)
        share = wear[3] * wp.clamp(grain, 0.1, 1.0)
        result.color = wp.lerp(result.color, DUST_COLOR, share)
        result.metallic = wp.lerp(result.metallic, 0.0, share)
        result.roughness = wp.lerp(result.roughness, DUST_ROUGHNESS, share)
    return result
