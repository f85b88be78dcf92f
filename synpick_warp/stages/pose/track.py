"""Tracking of object poses from frame to frame: motion hypotheses, refinement, near-symmetries told apart by colour, no restart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.kernels.pose.hypotheses import (
    MOTIONS,
    Track,
    TrackPolicy,
    propose_motions_kernel,
    update_tracks_kernel,
)
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.refine import LossScales, Refiner, Schedule, choose_poses
from synpick_warp.stages.pose.symmetries import SymmetrySearch

TRACK = struct_arrays(Track, "instance", units={"pose": "m", "before": "m", "centroid": "m"})

COARSE = Schedule(iterations=6, cutoffs=(0.03, 0.01), step=2, color=0.005, prior=1e-3)
"""Refinement of the motion hypotheses."""
FINE = Schedule(iterations=8, cutoffs=(0.012, 0.005), step=1, color=0.005, prior=1e-3)
"""Refinement of the best one and its best near-symmetry."""


@dataclass(frozen=True)
class TrackSettings:
    """Settings of the tracker: refinement schedules, use of colour, how much better a motion or near-symmetry must be to be taken, and
    limits of acceptance (`TrackPolicy`).
    """

    coarse: Schedule = COARSE
    fine: Schedule = FINE
    color: bool = True
    """Use colours to choose among near-symmetries, and in costs; in refinements the schedules say so."""
    loyalty: float = 0.05
    """Relative cost by which a motion must be better than rest."""
    symmetry_gain: float = 0.1
    """Correlation by which colours must fit worse than before for symmetries to be considered, and a symmetry better than the pose."""
    symmetry_loyalty: float = 0.15
    """Relative cost by which a symmetry must be better after refinement."""
    min_points: int = 16
    """See `TrackPolicy`, as for the next three."""
    surprise: float = 0.4
    patience: int = 5
    first_cost: float = 0.5


class Tracker:
    """Tracks the instances of an observer. `track` only launches kernels."""

    def __init__(self, models: PoseModels, observer: Observer, settings: TrackSettings, scales: LossScales) -> None:
        """
        Args:
            models: The object models.
            observer: Observes the instances.
            settings: Settings of the tracker.
            scales: Scales of the residuals.
        """
        self.models, self.observer, self.settings = models, observer, settings
        self.device, n = observer.device, observer.instances
        self.motions = Refiner(models, observer, int(MOTIONS), scales)
        self.symmetries = SymmetrySearch(models, observer, scales)
        self.pair = Refiner(models, observer, self.symmetries.hypotheses, scales)
        self.track_state = allocate_struct(TRACK, {"instance": n}, self.device)
        self.track_state.pose.fill_(wp.transform_identity())
        self.motion_pose = wp.zeros(n * int(MOTIONS), dtype=wp.transform, device=self.device)
        self.pair_pose = wp.zeros(n * self.symmetries.hypotheses, dtype=wp.transform, device=self.device)
        self.best = wp.zeros(n, dtype=wp.transform, device=self.device)
        self.cost = wp.zeros(n, dtype=float, device=self.device)
        self.start_pose = wp.zeros(n, dtype=wp.transform, device=self.device)
        self.starting = wp.zeros(n, dtype=int, device=self.device)
        self.policy = TrackPolicy()
        for name in ("min_points", "surprise", "patience", "first_cost"):
            setattr(self.policy, name, getattr(settings, name))

    def start(self, pose: np.ndarray, rows: np.ndarray) -> None:
        """Set the poses (N, 7) of the rows (N,) bool in the frame that is tracked next; the other tracks go on."""
        self.start_pose.assign(pose.astype(np.float32))
        self.starting.assign(rows.astype(np.int32))

    def track(self) -> None:
        """Estimate the poses of the observed frame: the state of the tracks, and `cost` of each instance."""
        settings, observer, device, n = self.settings, self.observer, self.device, self.observer.instances
        state, observation = self.track_state, observer.observation
        inputs = [state, observation, self.start_pose, self.starting]
        wp.launch(propose_motions_kernel, dim=n, inputs=inputs, outputs=[self.motion_pose], device=device)
        self.motions.refine(self.motion_pose, settings.coarse)
        cost = self.motions.score(self.motion_pose, color=settings.color)
        choose_poses(self.motion_pose, cost, int(MOTIONS), settings.loyalty, [self.best, self.cost], self.device)
        self.symmetries.propose(self.best, state.correlation, settings.symmetry_gain, self.pair_pose, color=settings.color)
        self.pair.refine(self.pair_pose, settings.fine)
        cost = self.pair.score(self.pair_pose, color=settings.color)
        choose_poses(self.pair_pose, cost, self.symmetries.hypotheses, settings.symmetry_loyalty, [self.best, self.cost], self.device)
        inputs = [self.policy, observation, self.best, self.cost, self.start_pose, self.starting]
        wp.launch(update_tracks_kernel, dim=n, inputs=inputs, outputs=[state], device=device)
        self.starting.zero_()
