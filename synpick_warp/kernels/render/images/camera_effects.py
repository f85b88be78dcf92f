"""Sensor and camera effects: sampled for each view from ranges (domain randomization), with the lens and sensor models that use them."""

import warp as wp

from synpick_warp.codes import Effect, Stream
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.rng import normal_pair, pixel_key, uniform, view_key

wp.set_module_options({"enable_backward": False})

EffectParameters = wp.types.vector(length=11, dtype=float)
"""Effect parameters of a view, by `Effect`: exposure, red, blue [EV], vignette, chromatic aberration [px], blur [px], shot noise, read
noise, JPEG quality, contrast, saturation; zero: off."""
BLUR_REACH = wp.constant(3.0)
"""The blur kernel is cut at this many standard deviations: 0.3 % of a Gaussian lie beyond."""
LUMA = wp.constant(wp.vec3(0.299, 0.587, 0.114))
"""Weights of red, green and blue in luma (ITU-R BT.601)."""


@wp.struct
class EffectRanges:
    """Lower and upper bound of each effect parameter, and the seed of the data set; see configs.cell.cameras.Effects."""

    seed: wp.uint64
    low: EffectParameters
    high: EffectParameters


@wp.struct
class SensorParameters:
    """Depth sensor model; see configs.cell.cameras.DepthSensor."""

    seed: wp.uint64
    baseline: float
    """From the camera to the projector, or to the right one of two cameras, to the right [m]."""
    disparity_step: float
    """Quantization step of disparity [px]."""
    disparity_noise: float
    """Standard deviation of disparity [px]."""
    max_disparity: float
    """Largest disparity that is measured [px]; 0: any."""
    near: float
    far: float
    """Measuring range of depth [m]."""
    noise: float
    """Axial noise at `noise_distance` [m]."""
    noise_growth: float
    """Growth of axial noise with the square of depth [1/m]."""
    noise_distance: float
    """Depth of least noise [m]."""
    noise_angle: float
    """Growth of axial noise with the angle of incidence [m^1.5]."""
    lateral_noise: float
    """Standard deviation of the pixel that is measured instead [px]."""
    noise_width: int
    """Distance of the lattice points between which noise is interpolated [px]; 1: each pixel has its own."""
    grazing_cosine: float
    """Cosine of the largest angle of incidence that is measured."""
    edge_width: int
    """Half width of the matching window [px]."""
    edge_step: float
    """Disparity difference within the window that invalidates a pixel [px]."""
    shadows: int
    """1: pixels that the projector does not light, or the infrared camera does not see, are invalid."""
    registration: float
    """Place on the baseline of the camera of the depth image: 0 that of the infrared camera, 1 that of the projector."""
    clear_reach: float
    """Distance behind a transparent surface at which 1/e of what is there is still measured [m]; 0: the surface counts as opaque."""
    counts_per_meter: float
    """Depth counts in a metre."""
    projector: float
    """From the left camera to the projector of dots, to the right [m]."""
    dot_spacing: float
    """Width of a cell of the pattern, which has one dot [px]."""
    dot_brightness: float
    """Brightness of dots on a white surface at 1 m, relative to full scale."""
    ambient: float
    """Brightness of ambient infrared light, relative to that of colour images."""
    infrared_noise: float
    """Standard deviation of infrared images, relative to full scale."""


@wp.func
def shot_key(seed: wp.uint64, shot: AnyShot, view: int, stream: int) -> wp.uint64:
    """Key of the random number stream (seed, episode, frame, camera, stream) of a view."""
    world = shot.views.world[view]
    return view_key(seed, shot.snapshot.episode[world], shot.snapshot.frame[world], shot.views.camera[view], stream)


@kernel_of_views
def sample_effects_kernel(
    # In:
    ranges: EffectRanges,
    shot: AnyShot,
    # Out:
    effects_out: wp.array[EffectParameters],  # (view)
):
    """Sample the effect parameters of each view: low_i + (high_i - low_i) u_i, with u_i uniform in [0, 1). u_i are of the random number
    stream (seed, episode, frame, camera, EFFECTS). JPEG quality is a uniform integer. Launched over view."""
    view = wp.tid()
    key = shot_key(ranges.seed, shot, view, Stream.EFFECTS)
    parameters = EffectParameters()
    for index in range(wp.static(len(Effect))):
        parameters[index] = ranges.low[index] + (ranges.high[index] - ranges.low[index]) * uniform(key, index)
    lowest = ranges.low[Effect.JPEG_QUALITY]
    highest = ranges.high[Effect.JPEG_QUALITY]
    parameters[Effect.JPEG_QUALITY] = wp.min(lowest + wp.floor((highest - lowest + 1.0) * uniform(key, Effect.JPEG_QUALITY)), highest)
    effects_out[view] = parameters


@wp.func
def adjust_display(color: wp.vec3ub, parameters: EffectParameters) -> wp.vec3ub:
    """Contrast c and saturation s of a camera's processing: y = 1/2 + (1 + c)(x - 1/2), then Y + (1 + s)(y - Y) with the luma Y of
    ITU-R BT.601, clipped and rounded; of sRGB values in 0..1."""
    contrast = parameters[Effect.CONTRAST]
    saturation = parameters[Effect.SATURATION]
    if contrast == 0.0 and saturation == 0.0:
        return color
    value = wp.vec3(float(color[0]), float(color[1]), float(color[2])) / 255.0
    value = wp.vec3(0.5, 0.5, 0.5) + (1.0 + contrast) * (value - wp.vec3(0.5, 0.5, 0.5))
    luma = wp.dot(LUMA, value)
    value = wp.vec3(luma, luma, luma) + (1.0 + saturation) * (value - wp.vec3(luma, luma, luma))
    return wp.vec3ub(to_byte(value[0]), to_byte(value[1]), to_byte(value[2]))


@wp.func
def to_byte(value: float) -> wp.uint8:
    """A value of 0..1 as a byte, clipped and rounded."""
    return wp.uint8(int(255.0 * wp.clamp(value, 0.0, 1.0) + 0.5))


@wp.kernel
def jpeg_quality_kernel(
    # In:
    effects: wp.array[EffectParameters],  # (view)
    fixed_quality: int,
    # Out:
    quality_out: wp.array[int],  # (view)
):
    """JPEG quality of each view: the sampled one, or `fixed_quality` where the effect is off (0). Launched over view."""
    view = wp.tid()
    sampled = int(effects[view][Effect.JPEG_QUALITY])
    quality_out[view] = wp.where(sampled > 0, sampled, fixed_quality)


@wp.func
def corner_slope(intrinsics: wp.vec4, width: int, height: int) -> wp.vec2:
    """Largest |x| and |y| of the rays (x, y, 1) through an image's corners."""
    x = wp.max(intrinsics[2], float(width) - intrinsics[2]) / intrinsics[0]
    y = wp.max(intrinsics[3], float(height) - intrinsics[3]) / intrinsics[1]
    return wp.vec2(x, y)


@wp.func
def vignette_factor(loss: float, ray: wp.vec3, corner: wp.vec2) -> float:
    """Transmitted fraction of light under cos⁴ vignetting: 1 - loss (1 - cos⁴θ) / (1 - cos⁴θ_corner), θ the angle to the optical axis."""
    if loss == 0.0:
        return 1.0
    square = 1.0 / (1.0 + ray[0] * ray[0] + ray[1] * ray[1])
    corner_square = 1.0 / (1.0 + wp.dot(corner, corner))
    return 1.0 - loss * (1.0 - square * square) / (1.0 - corner_square * corner_square)


@wp.func
def color_gains(parameters: EffectParameters) -> wp.vec3:
    """Exposure and white balance as factors on red, green and blue."""
    exposure = parameters[Effect.EXPOSURE]
    return wp.vec3(wp.pow(2.0, exposure + parameters[Effect.RED]), wp.pow(2.0, exposure), wp.pow(2.0, exposure + parameters[Effect.BLUE]))


@wp.func
def channel_magnification(channel: int, aberration: float, corner: float) -> float:
    """Lateral chromatic aberration as a magnification: red 1 + aberration / corner, green 1, blue 1 - aberration / corner. `corner` is the
    distance of the farthest corner from the principal point [px], `aberration` the displacement there [px]."""
    return 1.0 + float(1 - channel) * aberration / corner


@wp.func
def add_sensor_noise(value: wp.vec3, parameters: EffectParameters, key: wp.uint64, pixel: int) -> wp.vec3:
    """Add shot and read noise: Gaussian of variance shot² x + read² about the value x, relative to full scale, per channel."""
    shot = parameters[Effect.SHOT_NOISE]
    read = parameters[Effect.READ_NOISE]
    if shot == 0.0 and read == 0.0:
        return value
    stream = pixel_key(key, pixel)
    first = normal_pair(stream, 0)
    second = normal_pair(stream, 2)
    normal = wp.vec3(first[0], first[1], second[0])
    result = wp.vec3(0.0, 0.0, 0.0)
    for channel in range(3):
        deviation = wp.sqrt(shot * shot * wp.max(value[channel], 0.0) + read * read)
        result[channel] = value[channel] + deviation * normal[channel]
    return result
