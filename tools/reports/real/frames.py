"""Reader of annotated frames of a real RGB-D camera (YCB-Video's, by way of `oprb/ycbvideo`), for measuring only; and their paired
renderings (twins): the objects rendered at their poses, in front of the photograph itself.

Pixel centres are at + 0.5 in this project and at whole numbers in those frames, so `K` has 0.5 px added to the principal point.

Photograph and twin differ in the objects' appearance alone: materials, light, the camera's tone. A network is scored on both (the paired
gap); `synpick-warp gap` compares the pixels of each object, in BOP data sets.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import synpick_warp
from synpick_warp.apps.evaluation.twins import UNIT, Shot, render_twins
from synpick_warp.configs.files.load import parse_assignment
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.online.render import SceneRenderer
from synpick_warp.scenes.types import Camera
from synpick_warp.system.inputs.files import decode_json
from synpick_warp.system.inputs.image_files import decode_image

CENTER = 0.5
"""Pixel-centre offset [px]: the frames place the centre of the first pixel at 0, this package at half a pixel."""
_MILLIMETRES = 1e3
"""In a metre."""


@dataclass(frozen=True, eq=False)
class RealFrame:
    """Annotated frame: images (H, W), intrinsics (3, 3) [px], and poses of N objects in the frames of the models [mm]."""

    sequence: int
    image: int
    color: np.ndarray
    """RGB (H, W, 3) uint8."""
    depth: np.ndarray
    """Planar depth (H, W) uint16 [0.1 mm]; 0: not measured."""
    label: np.ndarray
    """obj_id of each pixel (H, W) uint8; 0: none of the objects."""
    intrinsics: np.ndarray
    """Camera matrix (3, 3) [px]; the centre of pixel (row, column) is (column + 0.5, row + 0.5)."""
    world_to_camera: np.ndarray
    """Matrix (3, 4): rotation, and translation [m]."""
    object_ids: tuple[int, ...]
    rotations: np.ndarray
    """Object to camera (N, 3, 3)."""
    translations: np.ndarray
    """Object to camera (N, 3) [mm]: of the bounding box's centre."""

    @property
    def name(self) -> str:
        """Name of the frame's files."""
        return f"{self.sequence:04d}_{self.image:06d}"

    def mask(self, index: int) -> np.ndarray:
        """Visible mask of an object (H, W) bool."""
        return self.label == self.object_ids[index]


def read_frames(folder: Path) -> list[RealFrame]:
    """Read all annotated frames of a folder, by name. Raises DatasetError: there are none, or a file is missing or damaged."""
    names = sorted(path.name.removesuffix("-poses.json") for path in folder.glob("*-poses.json"))
    if not names:
        raise DatasetError(f"{folder} has no frames (SSSS_FFFFFF-poses.json)")
    return [_read_frame(folder, name) for name in names]


def _read_frame(folder: Path, name: str) -> RealFrame:
    path = folder / f"{name}-poses.json"
    content = decode_json(_read(path), dict[str, Any], path, DatasetError)
    try:
        objects, matrix = content["objects"], np.array(content["K"], np.float64)
        matrix[:2, 2] += CENTER
        rotations = np.array([entry["R_model_to_camera"] for entry in objects]).reshape(-1, 3, 3)
        return RealFrame(
            sequence=int(content["sequence"]),
            image=int(content["frame"]),
            color=cv2.cvtColor(_image(folder / f"{name}-color.png"), cv2.COLOR_BGR2RGB),
            depth=_image(folder / f"{name}-depth.png"),
            label=_image(folder / f"{name}-label.png"),
            intrinsics=matrix,
            world_to_camera=np.array(content["world_to_camera"]),
            object_ids=tuple(int(entry["obj_id"]) for entry in objects),
            rotations=rotations,
            translations=_MILLIMETRES * np.array([entry["t_bop_m"] for entry in objects]).reshape(-1, 3),
        )
    except (KeyError, TypeError, ValueError) as fault:
        raise DatasetError(f"{path} is no record of poses: {fault}") from None


def _read(path: Path) -> bytes:
    """Content of a file; DatasetError without it."""
    try:
        return path.read_bytes()
    except OSError as fault:
        raise DatasetError(f"{path} cannot be read: {fault.strerror}") from None


def _image(path: Path) -> np.ndarray:
    return decode_image(_read(path), path, DatasetError)


def render_frames(frames: Sequence[RealFrame], options: argparse.Namespace) -> list[RealFrame]:
    """Twins of frames, and their labels, by a command line's `models`, `lights`, `device` and `set`. Raises SynpickError: one of these
    cannot be used."""
    if not options.models:
        raise ConfigError("twins need --models, the folder of the photographs' BOP models")
    given = dict(parse_assignment(text) for text in options.set) | {"bake.lights": options.lights, "bake.device": options.device}
    settings = synpick_warp.load_config(None, given | {"render.table": False})
    if not (shots := [_make_shot(frame, Path(options.models)) for frame in frames if frame.object_ids]):
        return list(frames)
    meshes = sorted({path for shot in shots for path, _ in shot.objects})
    twins = render_twins(shots, SceneRenderer(meshes, [shots[0].camera], (), UNIT, options.device, settings))
    labels = (np.array([0, *frame.object_ids], np.uint8) for frame in frames if frame.object_ids)
    made = (replace(twin.shot.source, color=twin.color, label=label[twin.instance]) for twin, label in zip(twins, labels, strict=True))
    return [next(made) if frame.object_ids else frame for frame in frames]


def _make_shot(frame: RealFrame, models: Path) -> Shot:
    """Frame of one object or more, to render. `models`: folder of BOP models."""
    view = np.linalg.inv(np.vstack([frame.world_to_camera, [0.0, 0.0, 0.0, 1.0]]))
    poses = np.tile(np.eye(4), (len(frame.object_ids), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = frame.rotations, UNIT * frame.translations
    objects = [(models / f"obj_{index:06d}.ply", view @ pose) for index, pose in zip(frame.object_ids, poses, strict=True)]
    return Shot(frame, frame.color, objects, Camera.at(matrix=frame.intrinsics, resolution=frame.label.shape[::-1], pose=view))
