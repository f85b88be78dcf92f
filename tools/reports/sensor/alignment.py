"""Rigid alignment of annotated poses to measured depth, so that the annotation's error does not count as the sensor's bias."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.configs.cell.sensors import DepthSensor
from tools.reports.sensor.scene import METRES, RealScenes, Rendered, back_project

ROUNDS = 3
"""Rounds of rendering and alignment."""
_STEPS = 8
"""Reweighted least-squares steps of a round."""
_TUKEY = 4.685
"""Tukey's constant, in standard deviations: 95 % efficiency for normal noise (Huber, 1981)."""
_MAD = 1.4826
"""Scale factor from the median absolute deviation of a normal distribution to its standard deviation: 1 / 0.6745."""
_INSIDE = 5
"""Least distance of points to the object's outline [px]."""
_FEWEST = 50
"""Fewest points by which an instance is aligned; with fewer it keeps its pose."""
_BLIND = DepthSensor(shadows=False)
"""Depth sensor of the renderings, whose image is not used."""


def robust_deviation(values: np.ndarray) -> float:
    """Robust standard deviation: 1.4826 times the median absolute deviation; NaN without values."""
    return float(_MAD * np.median(np.abs(values - np.median(values)))) if len(values) else float("nan")


def distances(mask: np.ndarray) -> np.ndarray:
    """Distance transform: distance of each pixel of a mask (H, W) bool to the nearest pixel outside of it [px]; 0 outside."""
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)


def inside(rendered: Rendered, row: int, index: int, margin: int = _INSIDE) -> np.ndarray:
    """Pixels (H, W) bool of an object in a frame, at least `margin` px from what is not the object."""
    return distances(rendered.owner[row] == index) >= margin


def align(scenes: RealScenes, poses: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Align each instance in each frame: point-to-plane ICP with projective association (Chen and Medioni, 1992) and Tukey's weights.

    Args:
        scenes: The frames.
        poses: Of each frame, object to camera (N, 4, 4) [m].

    Returns:
        The moved poses.
    """
    moved = [pose.copy() for pose in poses]
    for _ in range(ROUNDS):
        rendered = scenes.render(moved, _BLIND)
        for row, frame in enumerate(scenes.frames):
            points = back_project(frame, rendered.depth[row].astype(np.float64))
            measured = back_project(frame, METRES * frame.depth.astype(np.float64))
            for index in range(len(frame.object_ids)):
                use = inside(rendered, row, index) & (frame.label == frame.object_ids[index]) & (frame.depth > 0)
                if np.count_nonzero(use) < _FEWEST:
                    continue
                normals = rendered.normal[row][use]
                step = _solve(points[use], normals, ((measured - points)[use] * normals).sum(axis=-1))
                moved[row][index] = step @ moved[row][index]
    return moved


def _solve(points: np.ndarray, normals: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Rigid motion (4, 4) that takes points (P, 3) [m] along their normals by `off` (P) [m], in the least-squares sense, robustly."""
    center = points.mean(axis=0)
    jacobian = np.concatenate([np.cross(points - center, normals), normals], axis=1)
    motion = np.zeros(6)
    for _ in range(_STEPS):
        left = off - jacobian @ motion
        scaled = left / max(_TUKEY * robust_deviation(left), 1e-6)
        weight = np.where(np.abs(scaled) < 1.0, (1.0 - scaled**2) ** 2, 0.0)
        motion = np.linalg.lstsq(jacobian * np.sqrt(weight)[:, None], off * np.sqrt(weight), rcond=1e-4)[0]
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    result[:3, 3] = center - result[:3, :3] @ center + motion[3:]
    return result
