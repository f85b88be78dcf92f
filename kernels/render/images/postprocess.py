"""From linear radiance to the bytes of a picture: lens, exposure, sensor, tone curve, transfer curve, in this order."""

import warp as wp

from synpick_warp.codes import Effect, Stream, Tone
from synpick_warp.kernels.render.images.antialias import ShadedImage, pixel_radiance
from synpick_warp.kernels.render.images.camera_effects import (
    BLUR_REACH,
    Strengths,
    corner_slope,
    gains,
    magnification,
    noisy,
    vignette_factor,
)
from synpick_warp.kernels.render.lighting.color import srgb_byte
from synpick_warp.kernels.render.lighting.environment import Lights
from synpick_warp.kernels.render.visibility.camera import PIXEL_CENTER, Cameras, ImageGrid, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.rng import view_key

wp.set_module_options({"enable_backward": False, "fast_math": True})

LINEAR_PART = wp.constant(0.6)
"""SHOULDER leaves values below this untouched, so that colours keep their ratio."""
FILMIC_GAIN = wp.constant(0.7232)
"""Factor before FILMIC, so that middle grey, 0.18, stays what it is."""


@wp.func
def filmic_value(linear: float) -> float:
    """ACES' filmic curve as Narkowicz (2015) fits it, of FILMIC_GAIN times the value."""
    x = FILMIC_GAIN * linear
    return x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)


@wp.func
def display_value(linear: float, tone: int) -> wp.uint8:
    """sRGB byte of a linear value after a tone curve.

    SHOULDER: untouched up to LINEAR_PART, then a shoulder that reaches 1 at infinity, slope 1 where they meet. LINEAR: cut off at 1.
    """
    x = wp.max(linear, 0.0)
    if tone == Tone.FILMIC:
        x = filmic_value(x)
    elif tone == Tone.SHOULDER:
        if x > LINEAR_PART:
            rest = 1.0 - LINEAR_PART
            x = LINEAR_PART + rest * (1.0 - wp.exp((LINEAR_PART - x) / rest))
    return srgb_byte(x)


@wp.kernel
def develop_kernel(
    # Scene:
    grid: ImageGrid,
    lights: Lights,
    # State:
    light: wp.array[int],
    light_exposure: wp.array[float],
    # In:
    views: Views,
    image: ShadedImage,
    tone: int,
    first: int,
    # Out:
    color_out: wp.array3d[wp.vec3ub],
):
    """Radiance to sRGB bytes: exposure (the map's factor times 2 to the episode's stops), tone curve, transfer curve."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    world = views.world[view]
    value = lights.exposure[light[world]] * wp.pow(2.0, light_exposure[world]) * pixel_radiance(image, view, row, column)
    color_out[view, row, column] = wp.vec3ub(display_value(value[0], tone), display_value(value[1], tone), display_value(value[2], tone))


@wp.func
def spread_value(
    image: ShadedImage,
    strengths: Strengths,
    intrinsics: wp.vec4,
    grid: ImageGrid,
    view: int,
    row: int,
    column: int,
    channel: int,
    along_row: int,
) -> float:
    """One channel of a pixel after blur and chromatic aberration along one axis; both are products of what they do along each.

    The channel's picture is `magnification` times as large: read there, between two pixels, with Gaussian weights about the place.
    What lies beyond the border is taken to look like the border. The vignette dims what is read along the row, which is read first.
    """
    size = grid.height
    center = intrinsics[3]
    place = float(row) + PIXEL_CENTER
    loss = float(0.0)
    if along_row != 0:
        size = grid.width
        center = intrinsics[2]
        place = float(column) + PIXEL_CENTER
        loss = strengths[Effect.VIGNETTE]
    slope = corner_slope(intrinsics, grid.width, grid.height)
    radius = wp.length(wp.vec2(slope[0] * intrinsics[0], slope[1] * intrinsics[1]))
    place = center + (place - center) / magnification(channel, strengths[Effect.CHROMATIC_ABERRATION], radius) - PIXEL_CENTER
    low = int(wp.floor(place))
    share = place - float(low)
    sigma = strengths[Effect.BLUR]
    reach = int(wp.ceil(BLUR_REACH * sigma))
    total = float(0.0)
    weights = float(0.0)
    # Weight of the neighbour before: each pixel counts for the two Gaussians whose taps it lies between.
    before = float(0.0)
    for offset in range(-reach, reach + 2):
        weight = float(0.0)
        if offset <= reach:
            weight = 1.0
            if sigma > 0.0:
                weight = wp.exp(-0.5 * float(offset * offset) / (sigma * sigma))
        at = wp.clamp(low + offset, 0, size - 1)
        value = float(0.0)
        if along_row != 0:
            value = pixel_radiance(image, view, row, at)[channel]
            value *= vignette_factor(loss, camera_ray(intrinsics, row, at, wp.vec2(0.0, 0.0)), slope)
        else:
            value = image.radiance[view, at, column][channel]
        total += ((1.0 - share) * weight + share * before) * value
        weights += weight
        before = weight
    return total / weights


@wp.kernel
def spread_rows_kernel(
    # Scene:
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    effects: wp.array[Strengths],
    views: Views,
    image: ShadedImage,
    first: int,
    # Out:
    spread_out: wp.array3d[wp.vec3],
):
    """Vignette, then the part of blur and chromatic aberration that lies along rows; see `spread_value`."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    intrinsics = cameras.intrinsics[views.camera[view]]
    value = wp.vec3(0.0, 0.0, 0.0)
    for channel in range(3):
        value[channel] = spread_value(image, effects[view], intrinsics, grid, view, row, column, channel, 1)
    spread_out[view, row, column] = value


@wp.struct
class DevelopRules:
    """How a picture with effects is developed."""

    seed: wp.uint64
    tone: int
    spread: int
    """1: `spread_rows_kernel` went before, and the columns are still to be done; 0: no effect needs neighbours."""


@wp.kernel
def develop_effects_kernel(
    # Scene:
    cameras: Cameras,
    grid: ImageGrid,
    lights: Lights,
    # State:
    episode: wp.array[int],
    frame: wp.array[int],
    light: wp.array[int],
    light_exposure: wp.array[float],
    # In:
    rules: DevelopRules,
    effects: wp.array[Strengths],
    views: Views,
    image: ShadedImage,
    first: int,
    # Out:
    color_out: wp.array3d[wp.vec3ub],
):
    """As `develop_kernel`, with all effects: lens (unless done), exposure and white balance, noise of the sensor, tone and transfer curve.

    If `spread_rows_kernel` made `image.radiance`, its `mix` counts no more. Noise is that of the stream (seed, episode, frame, camera,
    Stream.COLOR_NOISE).
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    world = views.world[view]
    camera = views.camera[view]
    intrinsics = cameras.intrinsics[camera]
    strengths = effects[view]
    value = pixel_radiance(image, view, row, column)
    if rules.spread != 0:
        for channel in range(3):
            value[channel] = spread_value(image, strengths, intrinsics, grid, view, row, column, channel, 0)
    else:
        corner = corner_slope(intrinsics, grid.width, grid.height)
        value *= vignette_factor(strengths[Effect.VIGNETTE], camera_ray(intrinsics, row, column, wp.vec2(0.0, 0.0)), corner)
    value *= lights.exposure[light[world]] * wp.pow(2.0, light_exposure[world])
    value = wp.cw_mul(value, gains(strengths))
    key = view_key(rules.seed, episode[world], frame[world], camera, Stream.COLOR_NOISE)
    value = noisy(value, strengths, key, row * grid.width + column)
    color_out[view, row, column] = wp.vec3ub(
        display_value(value[0], rules.tone), display_value(value[1], rules.tone), display_value(value[2], rules.tone)
    )
