"""From linear radiance to the bytes of a picture: exposure, tone curve, transfer curve."""

import warp as wp

from synpick_warp.kernels.camera_rays import ImageGrid, tile_pixel
from synpick_warp.kernels.environment import Lights

wp.set_module_options({"enable_backward": False})

LINEAR_PART = wp.constant(0.6)
"""The tone curve leaves values below this untouched, so that colours keep their ratio."""


@wp.func
def display_value(linear: float) -> wp.uint8:
    """sRGB of a linear value: untouched up to LINEAR_PART, then a shoulder that reaches 1 at infinity, slope 1 where they meet."""
    x = linear
    if x > LINEAR_PART:
        rest = 1.0 - LINEAR_PART
        x = LINEAR_PART + rest * (1.0 - wp.exp((LINEAR_PART - x) / rest))
    encoded = 12.92 * x
    if x > 0.0031308:
        encoded = 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055
    return wp.uint8(wp.rint(255.0 * wp.clamp(encoded, 0.0, 1.0)))


@wp.kernel
def develop_kernel(
    # Scene:
    grid: ImageGrid,
    lights: Lights,
    # State:
    light: wp.array[int],
    light_exposure: wp.array[float],
    # In:
    view_world: wp.array[int],
    radiance: wp.array3d[wp.vec3],
    first: int,
    # Out:
    color_out: wp.array3d[wp.vec3ub],
):
    """Radiance to sRGB bytes: exposure (the map's factor times 2 to the episode's stops), tone curve, transfer curve."""
    pixel = tile_pixel(grid, wp.tid() + first)
    view = pixel[0]
    row = pixel[1]
    column = pixel[2]
    if row >= grid.height or column >= grid.width:
        return
    world = view_world[view]
    value = lights.exposure[light[world]] * wp.pow(2.0, light_exposure[world]) * radiance[view, row, column]
    color_out[view, row, column] = wp.vec3ub(display_value(value[0]), display_value(value[1]), display_value(value[2]))
