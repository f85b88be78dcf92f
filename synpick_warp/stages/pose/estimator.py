"""Pose estimator of a group of scenes: single-frame estimates, refinement and tracking behind one interface, on one device."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.stages.pose.batch import Estimates, InstanceTable, ObjectModel, RgbdBatch
from synpick_warp.stages.pose.detect import Detector, DetectSettings
from synpick_warp.stages.pose.models import PoseModels, build_models
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.refine import LossScales, Refiner, Schedule
from synpick_warp.stages.pose.templates import render_templates
from synpick_warp.stages.pose.track import Tracker, TrackSettings

APPROACH = Schedule(iterations=8, cutoffs=(0.03, 0.01), step=2, color=0.0)
"""First refinement of a disturbed pose, by shape alone: colours guide only where they nearly fit."""
POLISH = Schedule(iterations=10, cutoffs=(0.01, 0.005), step=1, color=0.005)
"""Second refinement of a disturbed pose."""
_NOISE_MARGIN, _NOISE_TRUNCATION, _NOISE_CUTOFF = 2.5, 1.5, 1.5
"""Increase of `LossScales.margin`, of `LossScales.truncation`, and of the last cutoff of a schedule, per standard deviation of the depth:
nine of ten points then count as if there were no noise."""


@dataclass(frozen=True)
class PoseSettings:
    """Settings of an estimator: use of colour, depth noise [m], maximum points of an instance, and least points for an estimate."""

    color: bool = True
    """Use colour beside depth and masks."""
    depth_noise: float = 0.0
    """Standard deviation of the depth [m]."""
    points: int = 256
    """Maximum surface points of an instance."""
    min_points: int = 16
    """Surface points below which an instance has no estimate, and a track keeps its pose."""


class EstimatorModels:
    """Object models, templates and settings on the device, shared by the estimators of all groups of scenes."""

    def __init__(self, objects: Sequence[ObjectModel], settings: PoseSettings, device: wp.Device) -> None:
        """
        Args:
            objects: The models; `InstanceTable.model` is the index into them.
            settings: Settings of the estimators.
            device: Where to compute.
        """
        self.settings, self.device = settings, device
        self.models: PoseModels = build_models(objects, device)
        self.detection = adapt(DetectSettings(), settings)
        self.tracking = replace(adapt(TrackSettings(), settings), min_points=settings.min_points)
        noise, scales = settings.depth_noise, LossScales()
        self.scales = replace(
            scales, margin=scales.margin + _NOISE_MARGIN * noise, truncation=scales.truncation + _NOISE_TRUNCATION * noise
        )

    @cached_property
    def templates(self) -> Any:
        """The struct `Templates`, rendered when it is first needed."""
        return render_templates(self.models, self.detection.search.directions, self.device)


class PoseEstimator:
    """Estimates the poses of the instances of a table. Owns its arrays; a batch goes to the device and back once."""

    def __init__(self, shared: EstimatorModels, instances: InstanceTable, height: int, width: int) -> None:
        """
        Args:
            shared: Models and settings.
            instances: The instances.
            height: Of the images [px].
            width: Of the images [px].
        """
        self.shared, self.instances, self.device = shared, instances, shared.device
        self.views = int(instances.view.max()) + 1
        self.observer = Observer(instances, self.views, height, width, shared.settings.points, self.device)

    @cached_property
    def _detector(self) -> Detector:
        """Detector of the instances, built when first needed."""
        shared = self.shared
        return Detector(shared.models, shared.templates, self.observer, shared.detection, shared.scales)

    @cached_property
    def _refiner(self) -> Refiner:
        """Refiner of one hypothesis per instance, built when first needed."""
        return Refiner(self.shared.models, self.observer, 1, self.shared.scales)

    @cached_property
    def _tracker(self) -> Tracker:
        """Tracker of the instances, built when first needed."""
        return Tracker(self.shared.models, self.observer, self.shared.tracking, self.shared.scales)

    def estimate(self, batch: RgbdBatch) -> Estimates:
        """Estimate the pose of each instance from a single frame."""
        detector = self._detector
        return self._run(batch, detector.detect, lambda: (detector.best, detector.cost))

    def refine(self, batch: RgbdBatch, pose: np.ndarray) -> Estimates:
        """Refine start poses (N, 7) float32, object to camera as in `Estimates`; returns the estimates."""
        refiner, settings = self._refiner, self.shared.settings
        poses = wp.array(pose, dtype=wp.transform, device=self.device)

        def refine() -> None:
            for schedule in (APPROACH, POLISH):
                refiner.refine(poses, adapt_schedule(schedule, settings))
            refiner.score(poses, color=settings.color)

        return self._run(batch, refine, lambda: (poses, refiner.cost))

    def start(self, pose: np.ndarray, rows: np.ndarray) -> None:
        """Set the poses (N, 7) float32 of the rows (N,) bool, in the frame that the next `track` is given; the others continue."""
        self._tracker.start(pose, rows)

    def track(self, batch: RgbdBatch) -> Estimates:
        """Estimate the poses of all instances that were started from their last poses; called for every frame in turn.

        An instance that shows too few points keeps its pose, and has no estimate. Where an estimate is rejected because it suddenly costs
        too much, the pose is the kept one, and the score, which is low, that of the rejected one.
        """
        tracker = self._tracker
        result = self._run(batch, tracker.track, lambda: (tracker.track_state.pose, tracker.cost))
        return replace(result, valid=result.valid & (tracker.track_state.frames.numpy() > 0))

    def _run(self, batch: RgbdBatch, launch: Callable[[], None], read: Callable[[], tuple[wp.array, wp.array]]) -> Estimates:
        """Observe a batch, launch an estimation (`launch`), and return its result (`read`) on the host."""
        begin = time.perf_counter()
        self.observer.observe(batch)
        launch()
        pose, cost = (array.numpy() for array in read())
        seconds = (time.perf_counter() - begin) / self.views
        valid = self.observer.observation.points.numpy() >= self.shared.settings.min_points
        n = len(self.instances)
        return Estimates(pose.copy(), np.exp(-cost).astype(np.float32), valid, np.full(n, seconds, np.float32))


def adapt(settings: Any, given: PoseSettings) -> Any:
    """Settings of a detector or tracker for the noise of the depth, with or without colour."""
    fine = adapt_schedule(settings.fine, given)
    return replace(settings, coarse=adapt_schedule(settings.coarse, given), fine=fine, color=given.color)


def adapt_schedule(schedule: Schedule, given: PoseSettings) -> Schedule:
    """Schedule adapted to the noise of the depth, with or without colour."""
    first, last = schedule.cutoffs
    last = min(last + _NOISE_CUTOFF * given.depth_noise, first)
    return replace(schedule, cutoffs=(first, last), color=schedule.color if given.color else 0.0)
