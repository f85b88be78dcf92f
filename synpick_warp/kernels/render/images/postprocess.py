"""Post-processing of linear radiance to sRGB bytes: lens, exposure, sensor noise, tone map, sRGB curve, contrast, in this order."""

from typing import Any

import warp as wp

from synpick_warp.codes import Effect, Stream, Tone
from synpick_warp.kernels.render.images.antialias import resolve_radiance
from synpick_warp.kernels.render.images.camera_effects import (
    BLUR_REACH,
    EffectParameters,
    add_sensor_noise,
    adjust_display,
    channel_magnification,
    color_gains,
    corner_slope,
    shot_key,
    vignette_factor,
)
from synpick_warp.kernels.render.lighting.color import srgb_byte
from synpick_warp.kernels.render.lighting.environment import Lights
from synpick_warp.kernels.render.lighting.tile_flags import needs
from synpick_warp.kernels.render.visibility.camera import PIXEL_CENTER, in_image, loop_ray, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import COLOR_PASS, AnyShot, ShadedImage
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False, "fast_math": True})

AnyWord = Any
"""Words in which whole images are copied: `wp.vec4ui`, `wp.uint32` or `wp.uint8`."""

SHOULDER_START = wp.constant(0.6)
"""Tone.SHOULDER is linear below this value, so that colours keep their ratio."""
FILMIC_GAIN = wp.constant(0.7232)
"""Factor before Tone.FILMIC, so that middle grey, 0.18, stays what it is."""


@wp.func
def filmic_curve(linear: float) -> float:
    """ACES filmic tone curve as Narkowicz (2015) fits it, of FILMIC_GAIN times the value."""
    x = FILMIC_GAIN * linear
    return x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)


@wp.func
def encode_display(linear: float, tone: int) -> wp.uint8:
    """Tone-map a linear value by the curve `tone` (a `Tone`) and encode it as an sRGB byte. SHOULDER: linear up to SHOULDER_START, then an
    exponential shoulder that reaches 1 at infinity, with slope 1 where they meet. LINEAR: clipped at 1. FILMIC: `filmic_curve`."""
    x = wp.max(linear, 0.0)
    if tone == Tone.FILMIC:
        x = filmic_curve(x)
    elif tone == Tone.SHOULDER:
        if x > SHOULDER_START:
            rest = 1.0 - SHOULDER_START
            x = SHOULDER_START + rest * (1.0 - wp.exp((SHOULDER_START - x) / rest))
    return srgb_byte(x)


@kernel_of_views
def postprocess_kernel(
    # Scene:
    lights: Lights,
    # In:
    shot: AnyShot,
    image: ShadedImage,
    tone: int,
    rows: wp.array[int],  # (view)
    first: int,
    # Out:
    color_inout: wp.array3d[wp.vec3ub],  # (rows, row, column)
):
    """Radiance to sRGB without camera effects: exposure (the map's factor times 2 to the episode's exposure value), tone map, transfer.

    `color_inout` receives red, green, blue bytes of tiles of COLOR_PASS, at the view's index in `rows`; without `rows`, at the view.
    Launched over view, pixel (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(shot.grid, wp.tid() + first)
    if not in_image(shot.grid, row, column) or not needs(shot.grid, image.passes, COLOR_PASS, view, row, column):
        return
    world, snapshot = shot.views.world[view], shot.snapshot
    value = (
        lights.exposure[snapshot.light[world]] * wp.pow(2.0, snapshot.light_exposure[world]) * resolve_radiance(image, view, row, column)
    )
    color = wp.vec3ub(encode_display(value[0], tone), encode_display(value[1], tone), encode_display(value[2], tone))
    place = view
    if rows:
        place = rows[view]
    color_inout[place, row, column] = color


@wp.kernel
def gather_images_kernel(
    # In:
    rows: wp.array[int],  # (image)
    images: wp.array2d[AnyWord],  # (row, word)
    # Out:
    images_out: wp.array2d[AnyWord],  # (image, word)
):
    """Gather: copy the images at the indices `rows`. Launched over image, word."""
    image, word = wp.tid()
    images_out[image, word] = images[rows[image], word]


@wp.func
def filter_lens(
    shot: AnyShot,
    intrinsics: wp.vec4,
    image: ShadedImage,
    parameters: EffectParameters,
    view: int,
    row: int,
    column: int,
    channel: int,
    along_row: int,
) -> float:
    """Separable lens filter: Gaussian blur and lateral chromatic aberration of one channel of a pixel, along one axis.

    The channel is magnified by `channel_magnification`: it is resampled at the inverse position, between two pixels, with Gaussian
    weights; coordinates are clamped to the image. The first pass, along the row, reads resolved radiance and applies the vignette.
    """
    grid, cameras = shot.grid, shot.views.cameras
    size = grid.height
    center = intrinsics[3]
    position = float(row) + PIXEL_CENTER
    loss = float(0.0)
    if along_row != 0:
        size = grid.width
        center = intrinsics[2]
        position = float(column) + PIXEL_CENTER
        loss = parameters[Effect.VIGNETTE]
    slope = corner_slope(intrinsics, grid.width, grid.height)
    radius = wp.length(wp.vec2(slope[0] * intrinsics[0], slope[1] * intrinsics[1]))
    scale = channel_magnification(channel, parameters[Effect.CHROMATIC_ABERRATION], radius)
    position = center + (position - center) / scale - PIXEL_CENTER
    low = int(wp.floor(position))
    fraction = position - float(low)
    sigma = parameters[Effect.BLUR]
    reach = int(wp.ceil(BLUR_REACH * sigma))
    total = float(0.0)
    weights = float(0.0)
    # Linear interpolation of the blurred signal: each pixel counts for the two Gaussians whose taps it lies between.
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
            value = resolve_radiance(image, view, row, at)[channel]
            value *= vignette_factor(loss, loop_ray(cameras, intrinsics, view, row, at, wp.vec2(0.0, 0.0)), slope)
        else:
            value = image.radiance[view, at, column][channel]
        total += ((1.0 - fraction) * weight + fraction * before) * value
        weights += weight
        before = weight
    return total / weights


@kernel_of_views
def filter_lens_rows_kernel(
    # In:
    effects: wp.array[EffectParameters],  # (view)
    shot: AnyShot,
    image: ShadedImage,
    first: int,
    # Out:
    radiance_out: wp.array3d[wp.vec3],  # (view, row, column)
):
    """First pass of the separable lens filter: resolve, vignette, then blur and chromatic aberration along rows; see `filter_lens`.
    `radiance_out` receives linear radiance before exposure. Launched over view, pixel (tile order, from flat index `first` on)."""
    view, row, column = tile_pixel(shot.grid, wp.tid() + first)
    if not in_image(shot.grid, row, column):
        return
    intrinsics = shot.views.cameras.intrinsics[view]
    value = wp.vec3(0.0, 0.0, 0.0)
    for channel in range(3):
        value[channel] = filter_lens(shot, intrinsics, image, effects[view], view, row, column, channel, 1)
    radiance_out[view, row, column] = value


@wp.struct
class PostProcessSettings:
    """Seed of the noise, tone map, and whether the lens filter has begun, for post-processing with camera effects."""

    seed: wp.uint64
    tone: int
    lens_filter: int
    """1: the image is the result of `filter_lens_rows_kernel`, and the pass along columns is due; 0: no effect needs neighbours."""


@kernel_of_views
def postprocess_effects_kernel(
    # Scene:
    lights: Lights,
    # In:
    settings: PostProcessSettings,
    effects: wp.array[EffectParameters],  # (view)
    shot: AnyShot,
    image: ShadedImage,
    first: int,
    # Out:
    color_out: wp.array3d[wp.vec3ub],  # (view, row, column)
):
    """Radiance to sRGB with camera effects: lens, exposure and white balance, sensor noise, tone map, transfer curve,
    contrast and saturation.

    After `filter_lens_rows_kernel` the lens filter's second pass, along columns, reads `image.radiance` alone, else the vignette is applied
    here. Noise is that of the random number stream (seed, episode, frame, camera, COLOR_NOISE). `color_out` receives red, green, blue
    bytes. Launched over view, pixel (tile order, from flat index `first` on).
    """
    grid, cameras, snapshot = shot.grid, shot.views.cameras, shot.snapshot
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    world = shot.views.world[view]
    intrinsics = cameras.intrinsics[view]
    parameters = effects[view]
    value = resolve_radiance(image, view, row, column)
    if settings.lens_filter != 0:
        for channel in range(3):
            value[channel] = filter_lens(shot, intrinsics, image, parameters, view, row, column, channel, 0)
    else:
        corner = corner_slope(intrinsics, grid.width, grid.height)
        ray = loop_ray(cameras, intrinsics, view, row, column, wp.vec2(0.0, 0.0))
        value *= vignette_factor(parameters[Effect.VIGNETTE], ray, corner)
    value *= lights.exposure[snapshot.light[world]] * wp.pow(2.0, snapshot.light_exposure[world])
    value = wp.cw_mul(value, color_gains(parameters))
    key = shot_key(settings.seed, shot, view, Stream.COLOR_NOISE)
    value = add_sensor_noise(value, parameters, key, row * grid.width + column)
    color = wp.vec3ub(
        encode_display(value[0], settings.tone), encode_display(value[1], settings.tone), encode_display(value[2], settings.tone)
    )
    color_out[view, row, column] = adjust_display(color, parameters)
