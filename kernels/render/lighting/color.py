"""Colour: Rec. 709 luminance and the sRGB transfer function."""

import warp as wp

wp.set_module_options({"enable_backward": False})

LUMINANCE_RED = wp.constant(0.2126)
LUMINANCE_GREEN = wp.constant(0.7152)
LUMINANCE_BLUE = wp.constant(0.0722)
"""Rec. 709 luma coefficients, linear."""
MIN_RADIANCE = wp.constant(1.0e-20)
"""Divisors that are radiances are at least this."""


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
