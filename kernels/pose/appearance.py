"""Silhouette and colour residuals of a hypothesis, from the samples of its model."""

import warp as wp

from synpick_warp.kernels.pose.lighting import CHANNELS, Lighting, harmonics
from synpick_warp.kernels.pose.observation import CROP, Images, Observation, Targets
from synpick_warp.kernels.pose.residuals import LANES, LossParameters, Models, Sums, jacobian, tukey_weight
from synpick_warp.kernels.pose.samples import PROTRUDING, VISIBLE, SampleView, has_color, interpolate_color, view_sample

# With Warp's default flags LLVM's SLP vectorizer makes invalid code of this module for CPUs with AVX-512 FP16, and the process aborts.
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native -fno-slp-vectorize"})

DEADBAND = wp.constant(0.75)
"""Distance from the mask that its sampling explains [crop px]."""


@wp.struct
class SilhouetteResidual:
    """Silhouette residual of a protruding sample (free-space violation): the shortest way back into the mask, at the depth of the
    sample."""

    distance: float
    """[m]; 0: it lies within the deadband."""
    direction: wp.vec3
    """Unit direction across the ray through the sample, in the camera frame."""


@wp.func
def silhouette_residual(observation: Observation, instance: int, sample: SampleView, intrinsics: wp.vec4) -> SilhouetteResidual:
    """Shortest way of a sample back to the nearest crop pixel of the mask, by the feature transform, minus the deadband."""
    column = wp.clamp(int(wp.round(sample.crop[0])), 0, CROP - 1)
    row = wp.clamp(int(wp.round(sample.crop[1])), 0, CROP - 1)
    target = observation.nearest[instance, row, column] + wp.vec2(float(column), float(row))
    offset = target - sample.crop
    pixels = wp.length(offset)
    result = SilhouetteResidual()
    if pixels > DEADBAND:
        scale = observation.pitch[instance] * sample.position[2]
        offset = wp.vec2(scale * offset[0] / intrinsics[0], scale * offset[1] / intrinsics[1])
        result.distance = wp.length(offset) * (1.0 - DEADBAND / pixels)
        offset = wp.normalize(offset)
        slope = (offset[0] * sample.position[0] + offset[1] * sample.position[1]) / sample.position[2]
        result.direction = wp.normalize(wp.vec3(offset[0], offset[1], -slope))
    return result


@wp.func
def intensity_gradient(across: float, down: float, intrinsics: wp.vec4, pitch: float, point: wp.vec3) -> wp.vec3:
    """Derivative of an intensity by the point that is projected [1/m], from its derivatives along the crop's columns and rows."""
    along = intrinsics[0] * across / (pitch * point[2])
    below = intrinsics[1] * down / (pitch * point[2])
    return wp.vec3(along, below, -(along * point[0] + below * point[1]) / point[2])


@wp.kernel
def accumulate_samples_kernel(
    # Scene:
    models: Models,
    loss: LossParameters,
    # In:
    images: Images,
    targets: Targets,
    observation: Observation,
    lighting: Lighting,
    pose: wp.array[wp.transform],  # (pose) [m]
    hypotheses: int,
    # Out:
    sums_inout: Sums,
):
    """Normal equations of silhouette (Huber) and photometric (Tukey) residuals: added to `sums_inout`; `Sums.samples` is written.

    A protruding sample is pulled towards the nearest pixel of the mask. The colour residual of a visible one is intensity - base colour x
    light, relative to the instance's mean; its derivative is the image gradient. Launched over hypothesis, lane.
    """
    index, lane = wp.tid()
    instance = index // hypotheses
    model = targets.model[instance]
    origin = wp.transform_get_translation(pose[index])
    radius, intrinsics = models.radius[model], images.intrinsics[targets.view[instance]]
    mean = observation.intensity[instance]
    hessian = wp.spatial_matrix()
    gradient = wp.spatial_vector()
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    samples = models.position.shape[1]
    if observation.points[instance] == 0:
        samples = 0
    for k in range(lane * loss.step, samples, LANES * loss.step):
        sample = view_sample(models, images, targets, observation, loss, instance, pose[index], k)
        area = sample.area * float(loss.step)
        if sample.state == PROTRUDING:
            residual = silhouette_residual(observation, instance, sample, intrinsics)
            total[0] += area * wp.min(residual.distance / loss.truncation, 1.0)
            if residual.distance > 0.0:
                weight = loss.silhouette * area * wp.min(1.0, loss.cutoff / residual.distance)
                line = jacobian(sample.position, origin, residual.direction, radius)
                hessian += weight * wp.outer(line, line)
                gradient += weight * residual.distance * line
        if sample.state == VISIBLE:
            total[1] += area
            if loss.color > 0.0 and mean > 0.0 and has_color(observation, instance, sample.crop):
                intensity, across, down = interpolate_color(observation, instance, sample.crop)
                basis = harmonics(sample.normal)
                total[3] += area
                for channel in range(CHANNELS):
                    light = wp.max(wp.dot(lighting.coefficients[index, channel], basis), 0.0)
                    error = (intensity[channel] - models.color[model, k][channel] * light) / mean
                    total[2] += area * wp.min(wp.abs(error) / loss.color_cutoff, 1.0) / float(CHANNELS)
                    change = intensity_gradient(across[channel], down[channel], intrinsics, observation.pitch[instance], sample.position)
                    line = jacobian(sample.position, origin, loss.color / mean * change, radius)
                    weight = area * tukey_weight(error, loss.color_cutoff) / float(CHANNELS)
                    hessian += weight * wp.outer(line, line)
                    gradient -= weight * loss.color * error * line
    sums_inout.hessian[index, lane] = sums_inout.hessian[index, lane] + hessian
    sums_inout.gradient[index, lane] = sums_inout.gradient[index, lane] + gradient
    sums_inout.samples[index, lane] = total
