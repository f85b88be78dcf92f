"""Pinhole cameras from position, look-at point and up vector."""

from __future__ import annotations

import numpy as np

from synpick_warp.configs.schema import Cameras
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.types import Camera

PARALLEL = 1e-6
"""Sine of the angle below which `up` counts as parallel to the viewing direction."""
_MIN_DISTANCE = 1e-6
"""Minimum distance between a camera and its target [m]."""


def make_cameras(cameras: Cameras) -> tuple[Camera, ...]:
    """Build the look-at cameras, in OpenCV's convention (x right, y down, z forward).

    fx = fy = (W / 2) / tan(fov / 2); the principal point is the middle of the image.

    Raises:
        ConfigError: There is no camera, positions and ups differ in length, a camera's position is the target, or its up vector is
            zero or parallel to its viewing direction.
    """
    if not cameras.positions:
        raise ConfigError("cameras.positions is empty; at least one camera is needed")
    if len(cameras.positions) != len(cameras.ups):
        raise ConfigError(
            f"cameras.positions has {len(cameras.positions)} entries and cameras.ups {len(cameras.ups)}; each camera needs one of both"
        )
    width, height = cameras.resolution
    focal = width / 2 / np.tan(np.radians(cameras.fov) / 2)
    matrix = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    result = []
    for index, (position, up) in enumerate(zip(cameras.positions, cameras.ups, strict=True)):
        rotation = _look_at(index, np.array(position, dtype=float), np.array(cameras.target, dtype=float), np.array(up, dtype=float))
        result.append(Camera(width, height, matrix.copy(), rotation, -rotation @ np.array(position, dtype=float)))
    return tuple(result)


def _look_at(index: int, position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World-to-camera rotation (3, 3): its rows are the camera's right, down and forward axes in the world."""
    if not all(np.isfinite(vector).all() for vector in (position, target, up)):
        raise ConfigError(f"cameras: camera {index} has a position, target or up that is not finite; give numbers")
    forward = target - position
    distance = np.linalg.norm(forward)
    if distance < _MIN_DISTANCE:
        raise ConfigError(f"cameras.positions: camera {index} is at cameras.target {_plain(target)}; move one of them")
    forward = forward / distance
    right = np.cross(forward, up)
    length = np.linalg.norm(right)
    if length <= PARALLEL * np.linalg.norm(up):
        raise ConfigError(
            f"cameras.ups: {_plain(up)} of camera {index} must not be zero or parallel to its viewing direction {_plain(forward)}; tilt it"
        )
    right = right / length
    return np.stack([right, np.cross(forward, right), forward])


def _plain(vector: np.ndarray) -> str:
    """Vector as text, for messages."""
    return "(" + ", ".join(f"{value:g}" for value in vector) + ")"
