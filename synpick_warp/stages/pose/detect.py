"""Single-frame pose estimation: template search, refinement of hypotheses, near-symmetries told apart by colour, last refinement."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import warp as wp

from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.refine import LossScales, Refiner, Schedule, choose_poses
from synpick_warp.stages.pose.symmetries import SymmetrySearch
from synpick_warp.stages.pose.templates import SearchSettings, TemplateSearch

COARSE = Schedule(iterations=12, cutoffs=(0.03, 0.01), step=2, color=0.0)
"""Refinement of the many hypotheses of the template search."""
FINE = Schedule(iterations=10, cutoffs=(0.012, 0.005), step=1, color=0.005)
"""Refinement of the best one and its best near-symmetry."""


@dataclass(frozen=True)
class DetectSettings:
    """Settings of single-frame pose estimation: template search, number of its poses that are refined, coarse and fine schedule, use of
    colour; how much better a near-symmetry must correlate in colour to be tried, and how much lower its cost must be to be chosen.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    hypotheses: int = 24
    """Poses of the template search that are refined."""
    coarse: Schedule = COARSE
    fine: Schedule = FINE
    color: bool = True
    symmetry_gain: float = 0.05
    """Correlation by which a symmetry must be better to become a hypothesis."""
    symmetry_loyalty: float = 0.0
    """Relative cost by which a symmetry must be better after refinement."""


class Detector:
    """Estimates poses from single views. `detect` only launches kernels."""

    def __init__(self, models: PoseModels, templates: Any, observer: Observer, settings: DetectSettings, scales: LossScales) -> None:
        """
        Args:
            models: The object models.
            templates: The struct `Templates`.
            observer: Observes the instances.
            settings: Settings.
            scales: Scales of the residuals.
        """
        self.observer, self.settings, self.device, n = observer, settings, observer.device, observer.instances
        self.search = TemplateSearch(templates, observer, settings.hypotheses, settings.search)
        self.many = Refiner(models, observer, settings.hypotheses, scales)
        self.symmetries = SymmetrySearch(models, observer, scales)
        self.pair = Refiner(models, observer, self.symmetries.hypotheses, scales)
        self.many_pose = wp.zeros(n * settings.hypotheses, dtype=wp.transform, device=self.device)
        self.pair_pose = wp.zeros(n * self.symmetries.hypotheses, dtype=wp.transform, device=self.device)
        self.best = wp.zeros(n, dtype=wp.transform, device=self.device)
        self.cost = wp.zeros(n, dtype=float, device=self.device)
        # Any correlation is below this mean, so that symmetries are always considered.
        self.unreached_mean = wp.zeros(n, dtype=float, device=self.device)

    def detect(self) -> None:
        """Estimate the poses of the observed views: `best` and `cost` of each instance."""
        settings = self.settings
        self.search.search(self.many_pose)
        self.many.refine(self.many_pose, settings.coarse)
        cost = self.many.score(self.many_pose, color=settings.color)
        choose_poses(self.many_pose, cost, settings.hypotheses, 0.0, [self.best, self.cost], self.device)
        self.unreached_mean.fill_(1.0e3)
        self.symmetries.propose(self.best, self.unreached_mean, settings.symmetry_gain, self.pair_pose, color=settings.color)
        self.pair.refine(self.pair_pose, settings.fine)
        cost = self.pair.score(self.pair_pose, color=settings.color)
        choose_poses(self.pair_pose, cost, self.symmetries.hypotheses, settings.symmetry_loyalty, [self.best, self.cost], self.device)
