"""Pose tables: estimated or true object poses of many images as columns, the common currency of the evaluation."""

from __future__ import annotations

from dataclasses import dataclass, replace

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


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """World-to-camera poses (M) of the images of cameras that move within their scene, sorted by scene and image.

    Motion, speed and tracks of objects are those in the world: for scenes of other cameras these are the same in camera coordinates.
    """

    scene: np.ndarray
    """Scene index (M,) int64."""
    image: np.ndarray
    """Image index (M,) int64."""
    rotation: np.ndarray
    """(M, 3, 3) float64."""
    translation: np.ndarray
    """(M, 3) float64 [m]."""

    def to_world(self, table: PoseTable) -> PoseTable:
        """Poses in the world in scenes of cameras that move; rows of other scenes as they are."""
        rows, at = self._find(table)
        back = self.rotation[at].transpose(0, 2, 1)
        return _with_poses(table, rows, back, np.einsum("nij,nj->ni", back, table.translation[rows] - self.translation[at]))

    def to_camera(self, table: PoseTable) -> PoseTable:
        """Poses in camera coordinates: the inverse of `to_world`."""
        rows, at = self._find(table)
        turn = self.rotation[at]
        return _with_poses(table, rows, turn, np.einsum("nij,nj->ni", turn, table.translation[rows]) + self.translation[at])

    def _find(self, table: PoseTable) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the table (n,) whose camera moves, and the index of each one's image (n,)."""
        place = {pair: index for index, pair in enumerate(zip(self.scene.tolist(), self.image.tolist(), strict=True))}
        at = np.array([place.get(pair, -1) for pair in zip(table.scene.tolist(), table.image.tolist(), strict=True)], np.int64)
        return np.flatnonzero(at >= 0), at[at >= 0]


def _with_poses(table: PoseTable, rows: np.ndarray, turn: np.ndarray, translation: np.ndarray) -> PoseTable:
    """Table with rotations turned and translations (n, 3) replaced in some rows (n,)."""
    rotations, translations = table.rotation.copy(), table.translation.copy()
    rotations[rows], translations[rows] = turn @ table.rotation[rows], translation
    return replace(table, rotation=rotations, translation=translations)
