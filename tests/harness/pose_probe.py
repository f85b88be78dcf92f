"""Test kernels that evaluate the device functions of pose estimation, and a harness for its normal equations."""

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.pose.appearance import accumulate_samples_kernel, intensity_gradient, silhouette_residual
from synpick_warp.kernels.pose.lighting import CHANNELS
from synpick_warp.kernels.pose.observation import Images, Observation, Targets
from synpick_warp.kernels.pose.residuals import LANES, LossParameters, Models, jacobian, tukey_weight
from synpick_warp.kernels.pose.samples import VISIBLE, has_color, interpolate_color, view_sample
from synpick_warp.kernels.pose.solve import StepLimits, apply_step, pose_difference, rotation_vector, solve_cholesky, step_poses_kernel
from synpick_warp.kernels.pose.surface import accumulate_points_kernel
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.refine import LIGHTING, SUMS

wp.set_module_options({"enable_backward": False})


@wp.kernel
def solve_kernel(
    matrix: wp.array[wp.spatial_matrix],
    right: wp.array[wp.spatial_vector],
    result_out: wp.array[wp.spatial_vector],
):
    """Cholesky solutions of 6 x 6 systems."""
    i = wp.tid()
    result_out[i] = solve_cholesky(matrix[i], right[i])


@wp.kernel
def step_kernel(
    pose: wp.array[wp.transform],
    step: wp.array[wp.spatial_vector],
    radius: float,
    pose_out: wp.array[wp.transform],
    back_out: wp.array[wp.spatial_vector],
    log_out: wp.array[wp.vec3],
):
    """Apply steps to poses: new poses, the differences from the old ones, and the rotation vectors of the new ones."""
    i = wp.tid()
    moved = apply_step(pose[i], step[i], radius)
    pose_out[i] = moved
    back_out[i] = pose_difference(moved, pose[i], radius)
    log_out[i] = rotation_vector(wp.transform_get_rotation(moved))


@wp.kernel
def residual_kernel(
    point: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    origin: wp.vec3,
    radius: float,
    cutoff: float,
    line_out: wp.array[wp.spatial_vector],
    weight_out: wp.array[float],
):
    """Jacobian of each point's motion, and the Tukey weight of its x coordinate taken as a residual."""
    i = wp.tid()
    line_out[i] = jacobian(point[i], origin, direction[i], radius)
    weight_out[i] = tukey_weight(point[i][0], cutoff)


@wp.kernel
def view_samples_kernel(
    models: Models,
    loss: LossParameters,
    images: Images,
    targets: Targets,
    observation: Observation,
    pose: wp.array[wp.transform],
    state_out: wp.array2d[int],
    position_out: wp.array2d[wp.vec3],
    normal_out: wp.array2d[wp.vec3],
    crop_out: wp.array2d[wp.vec2],
    area_out: wp.array2d[float],
    way_out: wp.array2d[wp.vec4],
    colored_out: wp.array2d[int],
    color_out: wp.array2d[wp.vec3],
    line_out: wp.array2d[wp.vec3],
):
    """Evaluate `view_sample` for every model sample, with its silhouette offset (direction, distance), colour and gradient of red."""
    instance, k = wp.tid()
    sample = view_sample(models, images, targets, observation, loss, instance, pose[instance], k)
    state_out[instance, k] = sample.state
    position_out[instance, k] = sample.position
    normal_out[instance, k] = sample.normal
    crop_out[instance, k] = sample.crop
    area_out[instance, k] = sample.area
    intrinsics = images.intrinsics[targets.view[instance]]
    if sample.area > 0.0:
        residual = silhouette_residual(observation, instance, sample, intrinsics)
        way_out[instance, k] = wp.vec4(residual.direction[0], residual.direction[1], residual.direction[2], residual.distance)
    if sample.state == VISIBLE and has_color(observation, instance, sample.crop):
        colored_out[instance, k] = 1
        color, across, down = interpolate_color(observation, instance, sample.crop)
        color_out[instance, k] = color
        line_out[instance, k] = intensity_gradient(across[0], down[0], intrinsics, observation.pitch[instance], sample.position)


OUTPUTS = {"state": int, "position": wp.vec3, "normal": wp.vec3, "crop": wp.vec2, "area": float, "way": wp.vec4}
OUTPUTS |= {"colored": int, "color": wp.vec3, "line": wp.vec3}


def view_samples(models: PoseModels, loss: Any, observer: Observer, pose: np.ndarray) -> dict[str, np.ndarray]:
    """Outputs of `view_samples_kernel` by name (instance, sample, ...), for poses (N, 7)."""
    shape = (observer.instances, models.models.position.shape[1])
    outputs = {name: wp.zeros(shape, dtype=kind, device=observer.device) for name, kind in OUTPUTS.items()}
    poses = wp.array(np.atleast_2d(pose).astype(np.float32), dtype=wp.transform, device=observer.device)
    inputs = [models.models, loss, observer.images, observer.targets, observer.observation, poses]
    wp.launch(view_samples_kernel, dim=shape, inputs=inputs, outputs=list(outputs.values()), device=observer.device)
    return {name: array.numpy() for name, array in outputs.items()}


class Normals:
    """Normal equations of one hypothesis per instance: from observed points, or from model samples."""

    def __init__(self, models: PoseModels, observer: Observer) -> None:
        self.models, self.observer, self.device = models, observer, observer.device
        sizes = {"pose": observer.instances, "lane": int(LANES), "channel": int(CHANNELS)}
        self.sums = allocate_struct(SUMS, sizes, self.device)
        self.lighting = allocate_struct(LIGHTING, sizes, self.device)
        self.even_light(1.0)

    def even_light(self, intensity: float) -> None:
        """Set uniform light: b = 0, with the given b₀."""
        shape = self.lighting.coefficients.shape
        self.lighting.coefficients.assign(np.tile(np.array([0.0, 0.0, 0.0, intensity], np.float32), (*shape, 1)))

    def poses(self, pose: np.ndarray) -> wp.array:
        return wp.array(np.atleast_2d(pose).astype(np.float32), dtype=wp.transform, device=self.device)

    def from_points(self, pose: np.ndarray, loss: Any) -> dict[str, np.ndarray]:
        """Sums of the surface residuals, added over the lanes in float64."""
        observer = self.observer
        inputs = [self.models.models, loss, observer.targets, observer.observation, self.poses(pose), 1]
        wp.launch(accumulate_points_kernel, dim=self._dim(), inputs=inputs, outputs=[self.sums], device=self.device)
        return self._read("hessian", "gradient", "points")

    def from_samples(self, pose: np.ndarray, loss: Any) -> dict[str, np.ndarray]:
        """Sums of the silhouette and colour residuals alone."""
        observer = self.observer
        self.sums.hessian.zero_()
        self.sums.gradient.zero_()
        inputs = [self.models.models, loss, observer.images, observer.targets, observer.observation, self.lighting, self.poses(pose), 1]
        wp.launch(accumulate_samples_kernel, dim=self._dim(), inputs=inputs, outputs=[self.sums], device=self.device)
        return self._read("hessian", "gradient", "samples")

    def step(self, pose: np.ndarray, limits: Any, prior: np.ndarray | None = None) -> np.ndarray:
        """Poses (N, 7) after one Gauss-Newton step with the sums accumulated last."""
        poses, observer = self.poses(pose), self.observer
        start = self.poses(pose if prior is None else prior)
        inputs = [self.models.models, limits, observer.targets, observer.observation, self.sums, start, 1]
        wp.launch(step_poses_kernel, dim=observer.instances, inputs=inputs, outputs=[poses], device=self.device)
        return poses.numpy()

    def _dim(self) -> tuple[int, int]:
        return self.observer.instances, int(LANES)

    def _read(self, *names: str) -> dict[str, np.ndarray]:
        return {name: getattr(self.sums, name).numpy().astype(np.float64).sum(axis=1) for name in names}


def step_limits(prior: float = 0.0, damping: float = 1e-6, distance: float = 0.02, angle: float = 0.25) -> Any:
    """The struct `StepLimits`."""
    limits = StepLimits()
    limits.prior, limits.damping, limits.distance, limits.angle = prior, damping, distance, angle
    return limits
