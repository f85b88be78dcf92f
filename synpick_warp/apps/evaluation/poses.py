"""Pose tables: estimated or true object poses of many images as columns, the common currency of the evaluation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses of objects in camera coordinates, one row each, in SI units; rows are sorted by scene, image and object."""

    scene: np.ndarray
    """Scene index (N,) int64: an episode and camera."""
    image: np.ndarray
    """Image index in the scene (N,) int64: the frame."""
    object_id: np.ndarray
    """obj_id (N,) int64."""
    rotation: np.ndarray
    """Rotation object to camera (N, 3, 3) float64."""
    translation: np.ndarray
    """Translation object to camera (N, 3) float64 [m]."""
    score: np.ndarray
    """Confidence of an estimate (N,) float64; 1 for ground truth."""
    seconds: np.ndarray
    """Time that the method took for the image (N,) float64 [s]; -1: unknown."""
    instance: np.ndarray
    """Instance index in the episode (N,) int64: the same in all frames; -1: unknown, as in BOP result files."""

    def __len__(self) -> int:
        return len(self.scene)

    def select(self, rows: np.ndarray) -> PoseTable:
        """Table of the rows that a mask or an index array selects."""
        return PoseTable(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))
