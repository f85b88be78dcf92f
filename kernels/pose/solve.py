"""Gauss-Newton steps on SO(3) x R³: damped normal equations solved by Cholesky factorization, and costs of hypotheses."""

import warp as wp

from synpick_warp.kernels.pose.observation import Observation, Targets
from synpick_warp.kernels.pose.residuals import LANES, LossParameters, Models, Sums

wp.set_module_options({"enable_backward": False})

MIN_PIVOT = wp.constant(1.0e-12)
"""Smallest pivot of the Cholesky factorization [m²]."""
MIN_COLOR_AREA = wp.constant(0.05)
"""Smallest area of samples with colour, relative to that of all visible samples, for colours to be compared."""
UNSEEN = wp.constant(1.0e6)
"""Cost of a hypothesis of an instance that is not visible."""


@wp.struct
class StepLimits:
    """Regularization and limits of a Gauss-Newton step."""

    prior: float
    """Weight of staying at the prior pose, relative to that of the observation."""
    damping: float
    """Levenberg's damping, relative to the weight of the observation."""
    distance: float
    """Largest translation of a step [m]."""
    angle: float
    """Largest rotation of a step [rad]."""


@wp.func
def solve_cholesky(matrix: wp.spatial_matrix, right: wp.spatial_vector) -> wp.spatial_vector:
    """Solve a symmetric positive definite system by A = L Lᵀ; pivots are at least `MIN_PIVOT`."""
    lower = wp.spatial_matrix()
    for j in range(6):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        root = wp.sqrt(wp.max(pivot, MIN_PIVOT))
        lower[j, j] = root
        for i in range(j + 1, 6):
            value = matrix[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            lower[i, j] = value / root
    half = wp.spatial_vector()
    for i in range(6):
        value = right[i]
        for k in range(i):
            value -= lower[i, k] * half[k]
        half[i] = value / lower[i, i]
    result = wp.spatial_vector()
    for j in range(6):
        i = 5 - j
        value = half[i]
        for k in range(i + 1, 6):
            value -= lower[k, i] * result[k]
        result[i] = value / lower[i, i]
    return result


@wp.func
def rotation_vector(rotation: wp.quat) -> wp.vec3:
    """Logarithm of a rotation: axis times angle [rad], the angle at most π."""
    axis = wp.vec3(rotation[0], rotation[1], rotation[2])
    real = rotation[3]
    if real < 0.0:
        axis = -axis
        real = -real
    sine = wp.length(axis)
    if sine < 1.0e-9:
        return 2.0 * axis
    return 2.0 * wp.atan2(sine, real) / sine * axis


@wp.func
def pose_difference(target: wp.transform, start: wp.transform, radius: float) -> wp.spatial_vector:
    """Step (w, v) [m] that moves the pose `start` to `target`."""
    rotation_step = wp.transform_get_rotation(target) * wp.quat_inverse(wp.transform_get_rotation(start))
    return wp.spatial_vector(
        radius * rotation_vector(rotation_step), wp.transform_get_translation(target) - wp.transform_get_translation(start)
    )


@wp.func
def apply_step(pose: wp.transform, step: wp.spatial_vector, radius: float) -> wp.transform:
    """Retraction on SO(3) x R³: exp(w / ρ) times the rotation, v plus the translation; the object's origin is the pivot."""
    rotation_step = wp.spatial_top(step) / radius
    angle = wp.length(rotation_step)
    rotation = wp.transform_get_rotation(pose)
    if angle > 1.0e-9:
        rotation = wp.normalize(wp.quat_from_axis_angle(rotation_step / angle, angle) * rotation)
    return wp.transform(wp.transform_get_translation(pose) + wp.spatial_bottom(step), rotation)


@wp.kernel
def step_poses_kernel(
    # Scene:
    models: Models,
    limits: StepLimits,
    # In:
    targets: Targets,
    observation: Observation,
    sums: Sums,
    prior: wp.array[wp.transform],  # (pose) [m]
    hypotheses: int,
    # Out:
    pose_inout: wp.array[wp.transform],  # (pose) [m]
):
    """Damped Gauss-Newton step s with a prior: solves (H + (λ + μ) A) s = g + μ A d.

    A is the observed area, d the step from the current pose to the prior, λ the damping and μ the weight of the prior.

    Launched over hypothesis.
    """
    index = wp.tid()
    instance = index // hypotheses
    count = observation.points[instance]
    if count == 0:
        return
    hessian = wp.spatial_matrix()
    gradient = wp.spatial_vector()
    for lane in range(LANES):
        hessian += sums.hessian[index, lane]
        gradient += sums.gradient[index, lane]
    area = observation.area[instance] * float(count)
    radius = models.radius[targets.model[instance]]
    for k in range(6):
        hessian[k, k] += (limits.damping + limits.prior) * area
    gradient += limits.prior * area * pose_difference(prior[index], pose_inout[index], radius)
    step = solve_cholesky(hessian, gradient)
    length = wp.max(wp.length(wp.spatial_bottom(step)) / limits.distance, wp.length(wp.spatial_top(step)) / (radius * limits.angle))
    if length > 1.0:
        step = step / length
    pose_inout[index] = apply_step(pose_inout[index], step, radius)


@wp.kernel
def score_poses_kernel(
    # Scene:
    loss: LossParameters,
    # In:
    observation: Observation,
    sums: Sums,
    hypotheses: int,
    # Out:
    cost_out: wp.array[float],  # (pose)
):
    """Cost of each hypothesis: truncated distances of points and protruding samples per observed area, + colour.

    The colour term is between 0 and `color_cost`; where too few samples show colour it is `color_cost`. Launched over hypothesis.
    """
    index = wp.tid()
    if observation.points[index // hypotheses] == 0:
        cost_out[index] = UNSEEN
        return
    points = wp.vec2()
    samples = wp.vec4()
    for lane in range(LANES):
        points += sums.points[index, lane]
        samples += sums.samples[index, lane]
    total = (points[0] + samples[0]) / points[1]
    if loss.color > 0.0:
        share = float(1.0)
        if samples[3] > MIN_COLOR_AREA * samples[1]:
            share = samples[2] / samples[3]
        total += loss.color_cost * share
    cost_out[index] = total
