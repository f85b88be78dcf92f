"""Data types of pose estimation: object models, batches of RGB-D views with instance masks, instances, estimates. Host memory, NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synpick_warp.scenes.types import Material, TriangleMesh

MAX_SLOTS = 255
"""Most instances of a view: labels are bytes, and 0 is nothing."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Textured mesh [m] and symmetries of an object whose pose is estimated: rigid transforms (4 x 4, row by row) and axes (direction,
    point [m]).
    """

    object_id: int
    """obj_id."""
    mesh: TriangleMesh
    """In the axes that poses refer to [m]."""
    material: Material
    symmetries_discrete: tuple[tuple[float, ...], ...]
    """Rigid transforms under which the object looks the same: row-major 4 x 4 matrices [m], without the identity."""
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
    """Axes of continuous rotational symmetry: (unit axis, point on the axis [m])."""


@dataclass(frozen=True, eq=False)
class RgbdBatch:
    """RGB-D views of equal size (V): sRGB colour, depth in counts (0: none) with the metres of a count, label image of visible masks (0:
    nothing, 1 + slot), intrinsics (fx, fy, cx, cy) [px].
    """

    color: np.ndarray
    """Colour, sRGB (V, H, W, 3) uint8, red first."""
    depth: np.ndarray
    """Planar depth (V, H, W) uint16 in counts; 0: none."""
    depth_scale: np.ndarray
    """Depth of one count (V,) float32 [m]."""
    label: np.ndarray
    """Visible masks as a label image (V, H, W) uint8: 0 nothing, 1 + slot the instance in this slot of the view."""
    intrinsics: np.ndarray
    """Pinhole parameters fx, fy, cx, cy (V, 4) float32 [px]; the centre of pixel (row, column) is (column + 0.5, row + 0.5)."""

    def __len__(self) -> int:
        """Number of views V."""
        return len(self.color)


@dataclass(frozen=True, eq=False)
class InstanceTable:
    """Instances whose pose is estimated: view, slot (mask label - 1) and model of each; rows stay the same for all frames of the views'
    scenes.
    """

    view: np.ndarray
    """Index of the view in the batch (N,) int32; every view has an instance."""
    slot: np.ndarray
    """Slot in the view (N,) int32: label - 1."""
    model: np.ndarray
    """Index of the model (N,) int32."""

    def __len__(self) -> int:
        """Number of instances N."""
        return len(self.view)


@dataclass(frozen=True, eq=False)
class Estimates:
    """Pose estimates of the N instances of a table in one frame."""

    pose: np.ndarray
    """Object to camera (N, 7) float32: translation x, y, z [m], unit quaternion x, y, z, w."""
    score: np.ndarray
    """Confidence (N,) float32; higher is better."""
    valid: np.ndarray
    """Whether the instance has an estimate in this frame (N,) bool."""
    seconds: np.ndarray
    """Time that the view of the instance took (N,) float32 [s]: that of the batch, divided by its views."""
