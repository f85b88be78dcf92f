"""Disturbed poses: start of a refinement, the truth moved by exactly 2 cm and turned by exactly 15° in random directions."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

OFFSET = 0.02
"""Length of the displacement [m]; the direction is uniform on the sphere. Length and angle are the same for all, so that a result states
its convergence at this distance instead of a mean over easy and hard starts."""
TURN = 15.0
"""Angle of the rotation about the object's origin [°]; the axis is uniform on the sphere."""


def disturb_pose(pose: np.ndarray, *key: int) -> np.ndarray:
    """Displace and rotate a pose (4, 4) [m].

    `key`: seed of the estimation, scene, frame and instance, which name the random numbers, whatever else is estimated.
    """
    move, axis = np.random.default_rng(key).normal(size=(2, 3))
    result = np.array(pose, np.float64)
    result[:3, 3] += OFFSET * move / np.linalg.norm(move)
    result[:3, :3] = Rotation.from_rotvec(np.radians(TURN) * axis / np.linalg.norm(axis)).as_matrix() @ result[:3, :3]
    return result
