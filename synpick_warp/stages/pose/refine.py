"""Pose refinement: Gauss-Newton on surface distances, silhouette and colour, for all hypotheses of all instances at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from synpick_warp.kernels.pose.appearance import accumulate_samples_kernel
from synpick_warp.kernels.pose.hypotheses import choose_poses_kernel
from synpick_warp.kernels.pose.lighting import CHANNELS, Lighting, accumulate_lighting_kernel, fit_lighting_kernel
from synpick_warp.kernels.pose.residuals import LANES, LossParameters, Sums
from synpick_warp.kernels.pose.solve import StepLimits, score_poses_kernel, step_poses_kernel
from synpick_warp.kernels.pose.surface import accumulate_points_kernel
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer

SUMS = struct_arrays(Sums, "pose", "lane", units={"hessian": "m²", "gradient": "m³", "points": "m²", "samples": "m²"})
LIGHTING = struct_arrays(Lighting, "pose", "lane", "channel", coefficients=("pose", "channel"))


@dataclass(frozen=True)
class Schedule:
    """Schedule of a refinement: iterations, outlier distances of the first and the last [m], stride of the points, colour weight [m],
    weight of the start.
    """

    iterations: int
    cutoffs: tuple[float, float]
    """Outlier distance of the first and the last iteration [m], geometric between."""
    step: int
    """Every n-th point and sample is used."""
    color: float
    """Length that a colour residual of the mean intensity counts as [m]; 0: no colour."""
    prior: float = 0.0
    """Weight of staying at the start, relative to the observation."""


@dataclass(frozen=True)
class LossScales:
    """Constants of a refinement: cutoffs [m], weights of silhouette and colour residuals, damping, largest step [m, rad]."""

    truncation: float = 0.01
    """Distance at which costs are truncated [m]."""
    margin: float = 0.006
    """Depth by which a model sample may lie in front of another surface without protruding [m]; more than the depth's noise."""
    silhouette: float = 0.5
    """Weight of silhouette residuals."""
    color_cutoff: float = 0.5
    """Colour residual that counts as an outlier, relative to the mean intensity."""
    color_cost: float = 0.3
    """Weight of colours in the costs of hypotheses."""
    damping: float = 1e-4
    """Weight of staying at the start (Levenberg-Marquardt), relative to the observation."""
    max_distance: float = 0.02
    """Longest translation of a step [m]."""
    max_angle: float = 0.25
    """Largest rotation of a step [rad]."""


class Refiner:
    """Gauss-Newton refinement and scoring of pose hypotheses. Owns its sums; only launches kernels."""

    def __init__(self, models: PoseModels, observer: Observer, hypotheses: int, scales: LossScales) -> None:
        """
        Args:
            models: The object models.
            observer: Observes the instances.
            hypotheses: Hypotheses per instance.
            scales: Scales of the residuals.
        """
        self.models, self.observer, self.hypotheses, self.scales = models, observer, hypotheses, scales
        self.device, poses = observer.device, observer.instances * hypotheses
        sizes = {"pose": poses, "lane": int(LANES), "channel": int(CHANNELS)}
        self.sums = allocate_struct(SUMS, sizes, self.device)
        self.lighting = allocate_struct(LIGHTING, sizes, self.device)
        self.prior = wp.zeros(poses, dtype=wp.transform, device=self.device)
        self.cost = wp.zeros(poses, dtype=float, device=self.device)

    def refine(self, pose: wp.array, schedule: Schedule) -> None:
        """Refine poses (pose) in place."""
        wp.copy(self.prior, pose)
        limits = StepLimits()
        limits.prior, limits.damping = schedule.prior, self.scales.damping
        limits.distance, limits.angle = self.scales.max_distance, self.scales.max_angle
        first, last = schedule.cutoffs
        observer = self.observer
        for iteration in range(schedule.iterations):
            cutoff = first * (last / first) ** (iteration / max(schedule.iterations - 1, 1))
            # The light changes slowly: fitting it every other step is enough.
            self._accumulate(pose, make_loss(self.scales, cutoff, schedule.step, schedule.color), fit_light=iteration % 2 == 0)
            inputs = [self.models.models, limits, observer.targets, observer.observation, self.sums, self.prior, self.hypotheses]
            wp.launch(step_poses_kernel, dim=len(pose), inputs=inputs, outputs=[pose], device=self.device)

    def score(self, pose: wp.array, *, color: bool, step: int = 1) -> wp.array:
        """Costs of poses (pose) float32, valid until the next call: unexplained and protruding fraction of the visible area, and colour."""
        loss = make_loss(self.scales, self.scales.truncation, step, 1.0 if color else 0.0)
        self._accumulate(pose, loss, fit_light=True)
        inputs = [loss, self.observer.observation, self.sums, self.hypotheses]
        wp.launch(score_poses_kernel, dim=len(pose), inputs=inputs, outputs=[self.cost], device=self.device)
        return self.cost

    def _accumulate(self, pose: wp.array, loss: Any, *, fit_light: bool) -> None:
        """Launch the kernels that sum normal equations and costs of all residuals."""
        observer, models, device = self.observer, self.models.models, self.device
        images, targets, observation = observer.images, observer.targets, observer.observation
        dim, hypotheses = (len(pose), int(LANES)), self.hypotheses
        inputs = [models, loss, targets, observation, pose, hypotheses]
        wp.launch(accumulate_points_kernel, dim=dim, inputs=inputs, outputs=[self.sums], device=device)
        if loss.color > 0.0 and fit_light:
            inputs = [models, loss, images, targets, observation, pose, hypotheses]
            wp.launch(accumulate_lighting_kernel, dim=dim, inputs=inputs, outputs=[self.lighting], device=device)
            wp.launch(fit_lighting_kernel, dim=len(pose), outputs=[self.lighting], device=device)
        inputs = [models, loss, images, targets, observation, self.lighting, pose, hypotheses]
        wp.launch(accumulate_samples_kernel, dim=dim, inputs=inputs, outputs=[self.sums], device=device)


def make_loss(scales: LossScales, cutoff: float, step: int, color: float) -> Any:
    """The struct `LossParameters`; see `Schedule` for the parameters that change in the course of a refinement."""
    loss = LossParameters()
    loss.cutoff, loss.step, loss.color = cutoff, step, color
    for name in ("truncation", "margin", "silhouette", "color_cutoff", "color_cost"):
        setattr(loss, name, getattr(scales, name))
    return loss


def choose_poses(pose: wp.array, cost: wp.array, hypotheses: int, loyalty: float, out: list[wp.array], device: wp.Device) -> None:
    """Choose the hypothesis of least cost for each instance.

    Args:
        pose: Hypotheses (pose).
        cost: Their costs (pose) float32.
        hypotheses: Hypotheses per instance.
        loyalty: Relative cost by which another hypothesis must be better than the first.
        out: Pose and cost (instance) of the chosen ones; written.
        device: Device of the arrays.
    """
    wp.launch(choose_poses_kernel, dim=len(pose) // hypotheses, inputs=[pose, cost, hypotheses, loyalty], outputs=out, device=device)
