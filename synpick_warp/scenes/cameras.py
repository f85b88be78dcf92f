"""Cameras of a rig: matrices and poses in float64, what each episode draws of them, and which stand in the gripper's way."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Stream
from synpick_warp.configs.calibration.lens import with_matrix
from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.cell.cameras import WORLD, CameraRow, Jitter, Pose, Rig, lens_map
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.configs.episodes.manipulation import Pick
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.types import Camera
from synpick_warp.system.linear_algebra import DECIMALS, dot, matmul, nearest_rotation, norm
from synpick_warp.system.linear_algebra import rotation as rotation_matrix
from synpick_warp.system.random_numbers import stream_key, uniform

PARALLEL = 1e-6
"""Sine of the angle below which `up` counts as parallel to the viewing direction."""
CAMERA_KEYS = ("matrix", "rotation", "translation")
"""Names of a camera's matrix and pose, in `Camera`, `FrameBatch` and records of episodes."""
_MIN_DISTANCE = 1e-6
"""Minimum distance between a camera and its target [m]."""


def make_cameras(rig: Rig) -> tuple[Camera, ...]:
    """Build the cameras of a rig, in OpenCV's convention (x right, y down, z forward).

    With a field of view fx = fy = (W / 2) / tan(fov / 2), and the principal point is the middle of the image. Raises ConfigError: a
    camera's position is its look-at point, or its up vector is zero or parallel to its viewing direction."""
    return tuple(_make_camera(rig.label(index), row, rig.shutter(index)) for index, row in enumerate(rig.rows))


def _make_camera(label: str, row: CameraRow, shutter: tuple[float, float]) -> Camera:
    width, height = row.resolution or (0, 0)
    if row.matrix is None:
        focal = width / 2 / round(float(np.tan(np.radians(row.fov or 0.0) / 2)), DECIMALS)
        matrix = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    else:
        matrix = np.array(row.matrix, dtype=float)
    rotation, position = place(label, row.pose)
    return Camera(width, height, matrix, rotation, -dot(rotation, position), row.name, lens_map(row), row.fixed_to or WORLD, shutter)


def place(label: str, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """World-to-frame rotation (3, 3) and position (3) [m] of a pose with OpenCV's axes; `label`: of its owner, for messages."""
    if pose.matrix is not None:
        to_world = np.array(pose.matrix, dtype=float)
        # The digits of a file end; the columns of a rotation must stay perpendicular.
        return nearest_rotation(to_world[:3, :3]).T, to_world[:3, 3]
    position = np.array(pose.position, dtype=float)
    if pose.quaternion is not None:
        return Rotation.from_quat(pose.quaternion).as_matrix().T, position
    if pose.look_at is None:
        return np.eye(3), position
    return _look_at(label, position, np.array(pose.look_at, dtype=float), np.array(pose.up, dtype=float)), position


def _look_at(label: str, position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World-to-camera rotation (3, 3): its rows are the camera's right, down and forward axes in the world."""
    if not all(np.isfinite(vector).all() for vector in (position, target, up)):
        raise ConfigError(f"{label} has a position, look-at point or up vector that is not finite; give numbers")
    forward = target - position
    distance = norm(forward)
    if distance < _MIN_DISTANCE:
        raise ConfigError(f"{label} is at its look-at point {_plain(target)}; move one of them")
    forward = forward / distance
    right = np.cross(forward, up)
    length = norm(right)
    if length <= PARALLEL * norm(up):
        raise ConfigError(
            f"the up vector {_plain(up)} of {label} must not be zero or parallel to its viewing direction {_plain(forward)}; tilt it"
        )
    right = right / length
    return np.stack([right, np.cross(forward, right), forward])


def is_in_way(place: Sequence[float] | np.ndarray, sizes: BinSizes, gripper: Gripper, pick: Pick) -> bool:
    """Whether a position lies in the gripper's swept volume during picks from a bin, where a camera sees only the shaft."""
    top = sizes.origin[2] + max(pick.appear_height, pick.lift_height) + gripper.cup_length + gripper.finger_length
    aside = np.abs(sizes.to_frame(tuple(place))[:2]) - np.divide(sizes.opening, 2.0)
    return place[2] < top and bool((aside < gripper.finger_width / 2.0).all())


def describe_cameras(picks: bool, rig: Rig, bins: Sequence[BinSizes], gripper: Gripper, pick: Pick) -> list[str]:
    """Warnings about cameras, a line each: in the gripper's swept volume in picks from any bin, if an episode `picks`; or with a pose of
    numbers from which none of the bins' middles is in the image, as by chance with the inverse of a pose."""
    noun, lines = bins[0].noun, []
    for camera, row in zip(make_cameras(rig), rig.rows, strict=True):
        if camera.fixed_to == WORLD and picks and any(is_in_way(camera.center, each, gripper, pick) for each in bins):
            lines.append(
                f"camera {camera.name} stands over the {noun}, in the gripper's way, and sees only its shaft in picks; move it aside or up"
            )
        points = matmul(np.array([np.mean(each.corners, axis=0) for each in bins]), camera.rotation.T) + camera.translation
        pixels = matmul(points, camera.matrix.T)[:, :2] / np.where(points[:, 2:] > 0.0, points[:, 2:], np.nan)
        seen = ((pixels >= 0.0) & (pixels <= camera.resolution)).all(axis=1)
        if camera.fixed_to == WORLD and row.pose.look_at is None and not seen.any():
            advice = "if its pose leads from the world to the camera, invert it"
            lines.append(f"camera {camera.name} has the middle of the {noun} beside its images; {advice}")
    return lines


class EpisodeCameras:
    """Cameras of episodes and views, where these are not those of the rig: in float64, from seed, episode and camera alone.

    Images are rendered with these numbers, and exported with them.
    """

    def __init__(self, rig: Rig, seed: int) -> None:
        self.cameras = make_cameras(rig)
        self.rig, self._seed = rig, seed
        self._draw = functools.lru_cache(maxsize=4096)(self._drawn)

    def of_episode(self, episode: int) -> tuple[Camera, ...]:
        """Cameras of an episode, with what it draws of them."""
        return tuple(self._draw(episode, camera) for camera in range(len(self.cameras)))

    def of_views(self, episode: np.ndarray, camera: np.ndarray, shaft: np.ndarray) -> dict[str, np.ndarray]:
        """Fields matrix, rotation and translation of `FrameBatch` for views of a group of the rig; none if all views have the rig's.
        `episode`: episode of each view (B). `camera`: camera of each view (B). `shaft`: pose of the gripper's shaft in each view: x, y, z
        [m], quaternion x, y, z, w (B, 7)."""
        if not len(camera) or not self.rig.is_placed(int(camera[0])):
            return {}
        drawn = [self._draw(*pair) for pair in zip(episode.tolist(), camera.tolist(), strict=True)]
        matrix, rotation, translation = (np.stack([getattr(one, name) for one in drawn]) for name in CAMERA_KEYS)
        if self.rig.moves(int(camera[0])):
            rotation, translation = carry(rotation, translation, shaft)
        return dict(zip(CAMERA_KEYS, (matrix, rotation, translation), strict=True))

    def record(self, episode: int) -> dict[str, Any] | None:
        """Record of an episode's cameras by name, those that are drawn or move: matrix [px], rotation and translation [m] from the world,
        or with `fixed_to` from what carries the camera; None: there is none."""
        records = {}
        for index, one in enumerate(self.of_episode(episode)):
            if self.rig.is_placed(index):
                records[one.name] = {key: getattr(one, key).tolist() for key in CAMERA_KEYS}
                records[one.name] |= {"fixed_to": one.fixed_to} if self.rig.moves(index) else {}
        return records or None

    def _drawn(self, episode: int, index: int) -> Camera:
        camera, jitter = self.cameras[index], self.rig.rows[index].jitter
        if self.rig.dome:
            key = stream_key(self._seed, episode, 0, Stream.DOME, index)
            pose = self.rig.dome.pose([uniform(key, sample) for sample in range(7)])
            at, *view = (np.array(vector) for vector in (pose.position, pose.look_at, pose.up))
            rotation = _look_at(self.rig.label(index), at, *view)
            camera = replace(camera, rotation=rotation, translation=-dot(rotation, at))
        if jitter is None:
            return camera
        position, rotation, focal_length, center = draw_jitter(jitter, self._seed, episode, index)
        matrix = camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= 1.0 + focal_length
        matrix[:2, 2] += center
        at = position + camera.center
        angle = norm(rotation)
        turned = matmul(rotation_matrix(rotation / (angle or 1.0), np.radians(angle)).T, camera.rotation)
        lens = with_matrix(camera.lens, matrix)
        return replace(camera, matrix=matrix, rotation=turned, translation=-dot(turned, at), lens=lens)


def carry(rotation: np.ndarray, translation: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotations (B, 3, 3) and translations (B, 3) [m] of cameras in what carries them, by its pose (B, 7) in the world.

    Poses of zeros, which snapshots have before their first tick and in dry runs, are the identity.
    """
    at, quaternion = pose[:, :3].astype(np.float64), pose[:, 3:].astype(np.float64)
    quaternion[~quaternion.any(axis=1), 3] = 1.0
    turned = matmul(rotation, Rotation.from_quat(quaternion).as_matrix().transpose(0, 2, 1))
    return turned, translation - dot(turned, at[:, None])


def draw_jitter(jitter: Jitter, seed: int, episode: int, camera: int) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Offset of the position [m], rotation vector [°], relative change of the focal length and offset of the centre [px] in an episode.

    The n-th of these nine numbers is drawn from samples 2 n and 2 n + 1 of the camera's stream.
    """
    key = stream_key(seed, episode, 0, Stream.CAMERA, camera)
    kinds = [jitter.position] * 3 + [jitter.rotation] * 3 + [jitter.focal_length] + [jitter.center] * 2
    drawn = [kind.sample(uniform(key, 2 * index), uniform(key, 2 * index + 1)) for index, kind in enumerate(kinds)]
    return np.array(drawn[:3]), np.array(drawn[3:6]), drawn[6], np.array(drawn[7:])


def _plain(vector: np.ndarray) -> str:
    """Vector as text, for messages."""
    return "(" + ", ".join(f"{value:g}" for value in vector) + ")"
