"""Effects of a view's camera: their strengths, drawn by address, and what they do to light and to the sensor's signal."""

import warp as wp

from synpick_warp.codes import Effect, Stream
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.rng import normal_pair, pixel_key, uniform, view_key

wp.set_module_options({"enable_backward": False})

Strengths = wp.types.vector(length=9, dtype=float)
"""A view's effects: exposure, red, blue [stops], vignette, chromatic aberration [px], blur [px], shot noise, read noise, JPEG quality."""
BLUR_REACH = wp.constant(3.0)
"""A blur ends at so many standard deviations: 0.3 % of a Gaussian lie beyond."""


@wp.struct
class EffectRules:
    """From what strengths are drawn; see configs.sensors.Effects."""

    seed: wp.uint64
    low: Strengths
    high: Strengths


@wp.kernel
def draw_effects_kernel(
    # State:
    episode: wp.array[int],
    frame: wp.array[int],
    # In:
    rules: EffectRules,
    views: Views,
    # Out:
    effects_out: wp.array[Strengths],
):
    """Draw each view's strengths: low_i + (high_i - low_i) u_i with the numbers u_i of the stream (seed, episode, frame, camera, EFFECTS).

    The quality of JPEG is a whole number, each as likely as the others.
    """
    view = wp.tid()
    world = views.world[view]
    key = view_key(rules.seed, episode[world], frame[world], views.camera[view], Stream.EFFECTS)
    strengths = Strengths()
    for index in range(wp.static(int(Effect.JPEG_QUALITY))):
        strengths[index] = rules.low[index] + (rules.high[index] - rules.low[index]) * uniform(key, index)
    lowest = rules.low[Effect.JPEG_QUALITY]
    highest = rules.high[Effect.JPEG_QUALITY]
    strengths[Effect.JPEG_QUALITY] = wp.min(lowest + wp.floor((highest - lowest + 1.0) * uniform(key, Effect.JPEG_QUALITY)), highest)
    effects_out[view] = strengths


@wp.func
def corner_slope(intrinsics: wp.vec4, width: int, height: int) -> wp.vec2:
    """Largest |x| and |y| of the rays (x, y, 1) of a picture's corners."""
    x = wp.max(intrinsics[2], float(width) - intrinsics[2]) / intrinsics[0]
    y = wp.max(intrinsics[3], float(height) - intrinsics[3]) / intrinsics[1]
    return wp.vec2(x, y)


@wp.func
def vignette_factor(loss: float, ray: wp.vec3, corner: wp.vec2) -> float:
    """Share of light that is left: 1 - loss (1 - cos⁴θ) / (1 - cos⁴θ_corner), θ being the angle to the optical axis."""
    if loss == 0.0:
        return 1.0
    square = 1.0 / (1.0 + ray[0] * ray[0] + ray[1] * ray[1])
    corner_square = 1.0 / (1.0 + wp.dot(corner, corner))
    return 1.0 - loss * (1.0 - square * square) / (1.0 - corner_square * corner_square)


@wp.func
def gains(strengths: Strengths) -> wp.vec3:
    """Factors on red, green and blue: exposure and white balance."""
    exposure = strengths[Effect.EXPOSURE]
    return wp.vec3(wp.pow(2.0, exposure + strengths[Effect.RED]), wp.pow(2.0, exposure), wp.pow(2.0, exposure + strengths[Effect.BLUE]))


@wp.func
def magnification(channel: int, aberration: float, corner: float) -> float:
    """How much larger a channel's picture is; `corner` is the corner's distance from the principal point, as `aberration` in px."""
    return 1.0 + float(1 - channel) * aberration / corner


@wp.func
def noisy(value: wp.vec3, strengths: Strengths, key: wp.uint64, pixel: int) -> wp.vec3:
    """What a sensor reads: Gaussian about the value x with variance shot² x + read², in shares of full scale, each channel on its own."""
    shot = strengths[Effect.SHOT_NOISE]
    read = strengths[Effect.READ_NOISE]
    if shot == 0.0 and read == 0.0:
        return value
    numbers = pixel_key(key, pixel)
    first = normal_pair(numbers, 0)
    second = normal_pair(numbers, 2)
    normal = wp.vec3(first[0], first[1], second[0])
    result = wp.vec3(0.0, 0.0, 0.0)
    for channel in range(3):
        deviation = wp.sqrt(shot * shot * wp.max(value[channel], 0.0) + read * read)
        result[channel] = value[channel] + deviation * normal[channel]
    return result
