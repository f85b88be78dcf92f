"""Colours: luminance, and bytes that a screen shows."""

import warp as wp

wp.set_module_options({"enable_backward": False})

LUMINANCE_RED = wp.constant(0.2126)
LUMINANCE_GREEN = wp.constant(0.7152)
LUMINANCE_BLUE = wp.constant(0.0722)
"""Rec. 709."""
LEAST_LIGHT = wp.constant(1.0e-20)
"""Light is kept off zero by this much before something is divided by it."""


@wp.func
def luminance(color: wp.vec3) -> float:
    return LUMINANCE_RED * color[0] + LUMINANCE_GREEN * color[1] + LUMINANCE_BLUE * color[2]


@wp.func
def srgb_byte(linear: float) -> wp.uint8:
    """sRGB value of a linear one (IEC 61966-2-1)."""
    encoded = 12.92 * linear
    if linear > 0.0031308:
        encoded = 1.055 * wp.pow(linear, 1.0 / 2.4) - 0.055
    return wp.uint8(wp.rint(255.0 * wp.clamp(encoded, 0.0, 1.0)))
