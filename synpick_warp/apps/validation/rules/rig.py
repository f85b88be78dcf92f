"""Rules about scenes that several cameras have recorded at the same time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec import UNSET

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.apps.validation.subjects import SceneSubject

DISTANCE_TOLERANCE, ANGLE_TOLERANCE = 0.1, 1e-3
"""Largest difference of an instance's world poses from two cameras [mm], [rad]; ours differ by 1e-12 mm."""


@dataclass(frozen=True, eq=False)
class RigSubject:
    """Scenes of the cameras of one episode, or of the sensors of one scene."""

    place: str
    scenes: tuple[SceneSubject, ...]
    cameras: int
    """Number of cameras that the rig has."""


@rule(RigSubject, "rig-complete", "restore the scene, or bake again: the same command resumes")
def check_complete(rig: RigSubject) -> Findings:
    """Every camera of an episode has its scene."""
    if len(rig.scenes) < rig.cameras:
        yield rig.place, f"{len(rig.scenes)} scenes of {rig.cameras} cameras"


@rule(RigSubject, "world-poses", "check the extrinsics' unit and direction (world to camera) and the pose of the instance")
def check_world_poses(rig: RigSubject) -> Findings:
    """cam_R_w2c and cam_t_w2c map an instance (instance_id) to the same world pose from every camera."""
    known: dict[tuple[int, int], tuple[str, np.ndarray]] = {}
    for scene in rig.scenes:
        record = scene.record("gt")
        for image, entries in scene.truths.items():
            camera = scene.cameras.get(image)
            if camera is None or not (isinstance(camera.cam_R_w2c, list) and isinstance(camera.cam_t_w2c, list)):
                continue
            to_world = _transform(camera.cam_R_w2c, camera.cam_t_w2c)
            to_world[:3, 3] = -to_world[:3, :3].T @ to_world[:3, 3]
            to_world[:3, :3] = to_world[:3, :3].T
            for index, item in enumerate(entries):
                if item.instance_id is UNSET:
                    continue
                pose = to_world @ _transform(item.cam_R_m2c, item.cam_t_m2c)
                first, other = known.setdefault((image, int(item.instance_id)), (record.where(image), pose))
                distance = float(np.linalg.norm(pose[:3, 3] - other[:3, 3]))
                angle = float(np.linalg.norm(pose[:3, :3] - other[:3, :3]) / np.sqrt(2.0))
                if distance > DISTANCE_TOLERANCE or angle > ANGLE_TOLERANCE:
                    off = f"{distance:.3g} mm and {np.degrees(min(angle, np.pi)):.2g}° off"
                    yield record.where(image), f"image {image}, instance {index}: its world pose is {off} that in {first}"


def _transform(rotation: Any, translation: Any) -> np.ndarray:
    """Rigid transform (4, 4) from a rotation (9 values, row by row) and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(rotation, (3, 3)), translation
    return matrix
