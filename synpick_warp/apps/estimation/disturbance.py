"""Disturbed poses: start of a refinement, the truth moved by exactly 2 cm and turned by exactly 15° in random directions."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.apps.estimation.draws import Draw, sample_uniform

OFFSET = 0.02
"""Length of the displacement [m]; the direction is uniform on the sphere. Length and angle are the same for all, so that a result states
its convergence at this distance instead of a mean over easy and hard starts."""
TURN = 15.0
"""Angle of the rotation about the object's origin [°]; the axis is uniform on the sphere."""


def disturb_poses(
    poses: np.ndarray, instances: np.ndarray, seed: int, scene: int, frame: int, offset: float = OFFSET, turn: float = TURN
) -> np.ndarray:
    """Displace and rotate poses.

    Args:
        poses: Object to camera (N, 4, 4) [m].
        instances: Instance indices (N,), which name the random samples together with seed, scene and frame.
        seed: Seed of the estimation.
        scene: Index of the scene.
        frame: Index of the image in the scene.
        offset: Length of the displacement [m].
        turn: Angle of the rotation [°].

    Returns:
        Disturbed poses (N, 4, 4) [m].
    """
    samples = sample_uniform(seed, scene, frame, Draw.DISTURBANCE, instances, 4)
    result = np.array(poses, np.float64)
    result[:, :3, 3] += offset * unit_vectors(samples[:, 0], samples[:, 1])
    axes = unit_vectors(samples[:, 2], samples[:, 3])
    result[:, :3, :3] = Rotation.from_rotvec(np.radians(turn) * axes).as_matrix().reshape(-1, 3, 3) @ result[:, :3, :3]
    return result


def unit_vectors(height: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) uniform on the sphere, from two uniform samples (N,) each (Archimedes' hat-box theorem)."""
    z, angle = 1.0 - 2.0 * height, 2.0 * np.pi * azimuth
    radius = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), z), axis=-1)
