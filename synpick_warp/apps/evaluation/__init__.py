"""Evaluation of pose estimates: BOP result files, ADD and ADD-S, AUC, tracking filter, tables and plots."""

from __future__ import annotations

from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.tracking.filtering import PAPER_ALPHAS, filter_poses
from synpick_warp.apps.evaluation.tracking.sweep import SWEEP_ALPHAS, AlphaSweep, split_by_mode, sweep_alpha
from synpick_warp.apps.evaluation.tracking.tracks import find_tracks, track_of_instance

__all__ = [
    "PAPER_ALPHAS",
    "SWEEP_ALPHAS",
    "AlphaSweep",
    "PoseTable",
    "filter_poses",
    "find_tracks",
    "split_by_mode",
    "sweep_alpha",
    "track_of_instance",
]
