"""What pose estimation sees of model samples, and a harness for its normal equations."""

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.pose.appearance import accumulate_samples_kernel, intensity_gradient, silhouette_residual
from synpick_warp.kernels.pose.lighting import CHANNELS
from synpick_warp.kernels.pose.observation import Images, Observation, Targets
from synpick_warp.kernels.pose.residuals import LANES, LossParameters, Models
from synpick_warp.kernels.pose.samples import VISIBLE, has_color, interpolate_color, view_sample
from synpick_warp.kernels.pose.solve import StepLimits, step_poses_kernel
from synpick_warp.kernels.pose.surface import accumulate_points_kernel
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.refine import LIGHTING, SUMS
from tests.harness.probe import probe


@wp.func
def view_colored_sample(
    models: Models,
    loss: LossParameters,
    images: Images,
    targets: Targets,
    observation: Observation,
    pose: wp.transform,
    instance: int,
    k: int,
):
    """`view_sample`, with the silhouette offset (direction, distance), whether it has a colour, the colour, and the gradient of red."""
    sample = view_sample(models, images, targets, observation, loss, instance, pose, k)
    intrinsics = images.intrinsics[targets.view[instance]]
    way = wp.vec4()
    color = wp.vec3()
    line = wp.vec3()
    if sample.area > 0.0:
        residual = silhouette_residual(observation, instance, sample, intrinsics)
        way = wp.vec4(residual.direction[0], residual.direction[1], residual.direction[2], residual.distance)
    colored = sample.state == VISIBLE and has_color(observation, instance, sample.crop)
    if colored:
        value, across, down = interpolate_color(observation, instance, sample.crop)
        color = value
        line = intensity_gradient(across[0], down[0], intrinsics, observation.pitch[instance], sample.position)
    return sample, way, colored, color, line


_view_samples = probe(view_colored_sample)


def view_samples(models: PoseModels, loss: Any, observer: Observer, pose: np.ndarray) -> dict[str, np.ndarray]:
    """Outputs of `view_colored_sample` by name (instance, sample, ...), for poses (N, 7)."""
    instance, k = np.indices((observer.instances, models.models.position.shape[1]))
    poses = np.broadcast_to(np.atleast_2d(pose), (observer.instances, 7))[:, None]
    inputs = (models.models, loss, observer.images, observer.targets, observer.observation, poses, instance, k)
    sample, *others = _view_samples(*inputs, device=observer.device)
    return {name: sample[name] for name in sample.dtype.names} | dict(zip(("way", "colored", "color", "line"), others, strict=True))


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
