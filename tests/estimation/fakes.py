"""Estimator for tests: it answers from the truth that it is told, and remembers what it was given."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from synpick_warp.stages.pose.batch import Estimates, InstanceTable, RgbdBatch


@dataclass
class FakeEstimator:
    """Returns poses as they were started or given, moved by `step` along x at each frame; a view takes a second."""

    table: InstanceTable
    step: float = 0.0
    pose: np.ndarray = field(init=False)
    labels: list[np.ndarray] = field(default_factory=list)
    started: list[np.ndarray] = field(default_factory=list)
    given: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.pose = np.zeros((len(self.table), 7), np.float32)
        self.pose[:, 6] = 1.0

    def estimate(self, batch: RgbdBatch) -> Estimates:
        """Centroid of the mask [px], as if it were metres."""
        self.labels.append(batch.label.copy())
        pose = self.pose.copy()
        valid = np.zeros(len(pose), bool)
        for row, (view, slot) in enumerate(zip(self.table.view, self.table.slot, strict=True)):
            rows, columns = np.nonzero(batch.label[view] == 1 + slot)
            valid[row] = len(rows) > 0
            pose[row, :3] = (columns.mean(), rows.mean(), batch.depth[view][rows, columns].mean()) if len(rows) else 0.0
        return self._answer(pose, valid)

    def refine(self, batch: RgbdBatch, pose: np.ndarray) -> Estimates:
        self.labels.append(batch.label.copy())
        self.given.append(pose.copy())
        return self._answer(pose, np.ones(len(pose), bool))

    def start(self, pose: np.ndarray, rows: np.ndarray) -> None:
        self.started.append(rows.copy())
        self.pose[rows] = pose[rows]

    def track(self, batch: RgbdBatch) -> Estimates:
        self.labels.append(batch.label.copy())
        self.pose[:, 0] += np.float32(self.step)
        return self._answer(self.pose.copy(), np.ones(len(self.pose), bool))

    def _answer(self, pose: np.ndarray, valid: np.ndarray) -> Estimates:
        score = np.full(len(pose), 0.5, np.float32)
        return Estimates(pose, score, valid, np.linspace(0.5, 1.0, len(pose), dtype=np.float32))
