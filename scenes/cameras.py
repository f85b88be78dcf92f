"""Cameras of a rig: matrices and poses in float64."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.configs.cameras import CameraRow
from synpick_warp.configs.rig import Rig, lens_map
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.types import Camera

PARALLEL = 1e-6
"""Sine of the angle below which `up` counts as parallel to the viewing direction."""
_MIN_DISTANCE = 1e-6
"""Minimum distance between a camera and its target [m]."""


def make_cameras(rig: Rig) -> tuple[Camera, ...]:
    """Build the cameras of a rig, in OpenCV's convention (x right, y down, z forward).

    With a field of view fx = fy = (W / 2) / tan(fov / 2), and the principal point is the middle of the image.

    Raises:
        ConfigError: A camera's position is its look-at point, or its up vector is zero or parallel to its viewing direction.
    """
    return tuple(_make_camera(rig.label(index), row) for index, row in enumerate(rig.rows))


def _make_camera(label: str, row: CameraRow) -> Camera:
    """Camera of a row with a resolution."""
    width, height = row.resolution or (0, 0)
    if row.matrix is None:
        focal = width / 2 / np.tan(np.radians(row.fov or 0.0) / 2)
        matrix = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    else:
        matrix = np.array(row.matrix, dtype=float)
    pose = row.pose
    if pose.matrix is not None:
        to_world = np.array(pose.matrix, dtype=float)
        # The digits of a file end; the columns of a rotation must stay perpendicular.
        rotation, position = Rotation.from_matrix(to_world[:3, :3]).as_matrix().T, to_world[:3, 3]
    else:
        position = np.array(pose.position, dtype=float)
        if pose.quaternion is not None:
            rotation = Rotation.from_quat(pose.quaternion).as_matrix().T
        else:
            rotation = _look_at(label, position, np.array(pose.look_at, dtype=float), np.array(pose.up, dtype=float))
    return Camera(width, height, matrix, rotation, -rotation @ position, row.name, lens_map(row))


def _look_at(label: str, position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World-to-camera rotation (3, 3): its rows are the camera's right, down and forward axes in the world."""
    if not all(np.isfinite(vector).all() for vector in (position, target, up)):
        raise ConfigError(f"{label} has a position, look-at point or up vector that is not finite; give numbers")
    forward = target - position
    distance = np.linalg.norm(forward)
    if distance < _MIN_DISTANCE:
        raise ConfigError(f"{label} is at its look-at point {_plain(target)}; move one of them")
    forward = forward / distance
    right = np.cross(forward, up)
    length = np.linalg.norm(right)
    if length <= PARALLEL * np.linalg.norm(up):
        raise ConfigError(
            f"the up vector {_plain(up)} of {label} must not be zero or parallel to its viewing direction {_plain(forward)}; tilt it"
        )
    right = right / length
    return np.stack([right, np.cross(forward, right), forward])


def _plain(vector: np.ndarray) -> str:
    """Vector as text, for messages."""
    return "(" + ", ".join(f"{value:g}" for value in vector) + ")"
