"""Light on an instance: first-order spherical harmonics, fitted to the colours of the visible samples by least squares."""

import warp as wp

from synpick_warp.kernels.pose.observation import Images, Observation, Targets
from synpick_warp.kernels.pose.residuals import LANES, LossParameters, Models
from synpick_warp.kernels.pose.samples import VISIBLE, has_color, interpolate_color, view_sample

wp.set_module_options({"enable_backward": False})

CHANNELS = wp.constant(3)
LIGHT_RIDGE = wp.constant(0.03)
"""Ridge on the directional coefficients of the light, relative to the base colours' mean square: flat surfaces do not determine them."""


@wp.struct
class Lighting:
    """First-order spherical harmonics that light an instance, by pose and colour channel: partial sums of the normal equations by lane, and
    the solved coefficients.
    """

    moments: wp.array3d[wp.mat44]
    """(pose, lane, channel): partial sums of the normal equations."""
    products: wp.array3d[wp.vec4]
    """(pose, lane, channel): partial sums of the right-hand sides."""
    coefficients: wp.array2d[wp.vec4]
    """(pose, channel): b, b₀."""


@wp.func
def harmonics(normal: wp.vec3) -> wp.vec4:
    """First-order spherical harmonics without their constants: (x, y, z, 1)."""
    return wp.vec4(normal[0], normal[1], normal[2], 1.0)


@wp.kernel
def accumulate_lighting_kernel(
    # Scene:
    models: Models,
    loss: LossParameters,
    # In:
    images: Images,
    targets: Targets,
    observation: Observation,
    pose: wp.array[wp.transform],  # (pose) [m]
    hypotheses: int,
    # Out:
    lighting_out: Lighting,
):
    """Normal equations of the lighting: least squares of intensity against base colour times harmonics, over visible samples.

    Writes the partial sums `moments` and `products`. Launched over hypothesis, lane.
    """
    index, lane = wp.tid()
    instance = index // hypotheses
    model = targets.model[instance]
    red = wp.mat44()
    green = wp.mat44()
    blue = wp.mat44()
    red_product = wp.vec4()
    green_product = wp.vec4()
    blue_product = wp.vec4()
    if observation.points[instance] > 0:
        for k in range(lane * loss.step, models.position.shape[1], LANES * loss.step):
            sample = view_sample(models, images, targets, observation, loss, instance, pose[index], k)
            if sample.state == VISIBLE and has_color(observation, instance, sample.crop):
                intensity, across, down = interpolate_color(observation, instance, sample.crop)
                base = models.color[model, k]
                basis = harmonics(sample.normal)
                square = sample.area * wp.outer(basis, basis)
                red += base[0] * base[0] * square
                green += base[1] * base[1] * square
                blue += base[2] * base[2] * square
                red_product += sample.area * base[0] * intensity[0] * basis
                green_product += sample.area * base[1] * intensity[1] * basis
                blue_product += sample.area * base[2] * intensity[2] * basis
    lighting_out.moments[index, lane, 0] = red
    lighting_out.moments[index, lane, 1] = green
    lighting_out.moments[index, lane, 2] = blue
    lighting_out.products[index, lane, 0] = red_product
    lighting_out.products[index, lane, 1] = green_product
    lighting_out.products[index, lane, 2] = blue_product


@wp.kernel
def fit_lighting_kernel(
    # Out:
    lighting_inout: Lighting,
):
    """Ridge regression of the lighting: solve the normal equations, with a ridge on the directional part, for `coefficients`.

    Launched over hypothesis.
    """
    index = wp.tid()
    for channel in range(CHANNELS):
        moments = wp.mat44()
        products = wp.vec4()
        for lane in range(LANES):
            moments += lighting_inout.moments[index, lane, channel]
            products += lighting_inout.products[index, lane, channel]
        result = wp.vec4()
        if moments[3, 3] > 0.0:
            ridge = LIGHT_RIDGE * moments[3, 3]
            for k in range(3):
                moments[k, k] += ridge
            result = wp.inverse(moments) * products
        lighting_inout.coefficients[index, channel] = result
