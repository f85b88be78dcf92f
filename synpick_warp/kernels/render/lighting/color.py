"""Colour: Rec. 709 luminance, the sRGB transfer function, and packed colours in half precision."""

import warp as wp

wp.set_module_options({"enable_backward": False})

LUMINANCE_RED = wp.constant(0.2126)
LUMINANCE_GREEN = wp.constant(0.7152)
LUMINANCE_BLUE = wp.constant(0.0722)
"""Rec. 709 luminance weights of linear RGB."""
MIN_RADIANCE = wp.constant(1.0e-20)
"""Divisors that are radiances are at least this."""
MAX_HALF = wp.constant(60000.0)
"""Largest packed value; half precision ends at 65,504."""


@wp.func
def luminance(color: wp.vec3) -> float:
    """Rec. 709 luminance of a linear colour."""
    return LUMINANCE_RED * color[0] + LUMINANCE_GREEN * color[1] + LUMINANCE_BLUE * color[2]


@wp.func
def srgb_byte(linear: float) -> wp.uint8:
    """Encode a linear value as 8-bit sRGB (IEC 61966-2-1)."""
    encoded = 12.92 * linear
    if linear > 0.0031308:
        encoded = 1.055 * wp.pow(linear, 1.0 / 2.4) - 0.055
    return wp.uint8(wp.rint(255.0 * wp.clamp(encoded, 0.0, 1.0)))


@wp.func
def pack_half3(color: wp.vec3) -> wp.uint64:
    """Pack three non-negative values in half precision, clamped to its range, so that a single load reads them."""
    clamped = wp.min(color, wp.vec3(MAX_HALF, MAX_HALF, MAX_HALF))
    halves = wp.vec4h(wp.float16(clamped[0]), wp.float16(clamped[1]), wp.float16(clamped[2]), wp.float16(0.0))
    return wp.cast(halves, wp.uint64)


@wp.func
def unpack_half3(packed: wp.uint64) -> wp.vec3:
    """Three values in half precision, packed by `pack_half3`, as float32."""
    # Two words: shorter than shifts of 64 bits.
    lower = wp.cast(wp.uint32(packed), wp.vec2h)
    upper = wp.cast(wp.uint32(packed >> wp.uint64(32)), wp.vec2h)
    return wp.vec3(float(lower[0]), float(lower[1]), float(upper[0]))


@wp.func
def tag_half3(packed: wp.uint64, tag: wp.uint32) -> wp.uint64:
    """Values of `pack_half3` with the lowest 16 bits of `tag` in the bits that they leave free; `unpack_half3` ignores them."""
    return packed | (wp.uint64(tag) << wp.uint64(48))


@wp.func
def half3_tag(packed: wp.uint64) -> wp.uint32:
    """Lowest 16 bits of the tag that `tag_half3` stored."""
    return wp.uint32(packed >> wp.uint64(48))
