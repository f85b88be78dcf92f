"""Ground truth of one scene as arrays, read from a BOP folder or from shards; images are not read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec import UnsetType

from synpick_warp.dataset.annotations import ADVICE, InfoEntry, Key, TruthEntry, check_content
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view_files import SceneFiles, SceneFolder
from synpick_warp.errors import DatasetError
from synpick_warp.inputs.json import read_json
from synpick_warp.statistics.records import Light, LitCameraEntry


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """A scene of F frames and N instances in all of them together."""

    frames: int
    counts: np.ndarray
    """Instances of each frame (F,) int64."""
    object_id: np.ndarray
    """obj_id (N,) int64."""
    visibility: np.ndarray
    """Visible fraction (N,) float64; NaN: it is not known."""
    direction: np.ndarray
    """Unit vector from the object's origin to the camera, in the object's frame (N, 3) float64."""
    light: Light | None
    """Light of the first frame; None: it is not told."""
    depth_scale: np.ndarray
    """Depth scale of each frame (F,) float64 [mm per count]; NaN: it has no depth."""
    files: SceneFiles
    """Reader of the scene's images."""
    images: Sequence[int] = ()
    """BOP's im_id of each frame."""


def read_scene(data_set: DataSet, episode: int, camera: int) -> SceneTruth:
    """Read the scene of an episode's camera.

    Raises:
        DatasetError: The data set has no images of it, or a file is missing or damaged.
    """
    files = data_set.scene_files(episode, camera)
    images = files.frames() if files.lenient else range(len(data_set[episode]))
    frames = len(images)
    if isinstance(files, SceneFolder) and not files.lenient:
        cameras, truth, infos = _read_folder(files, frames)
    else:
        cameras, truth, infos = _read_views(files, images)
    for frame in range(frames):
        if len(truth[frame]) != len(infos[frame]):
            raise DatasetError(f"{files.place}: image {frame} has other instances in scene_gt than in scene_gt_info; {ADVICE}")
    entries = [entry for each in truth for entry in each]
    rotation = np.reshape(np.array([entry.cam_R_m2c for entry in entries], np.float64), (-1, 3, 3))
    translation = np.reshape(np.array([entry.cam_t_m2c for entry in entries], np.float64), (-1, 3))
    # The camera is at the origin: R d = -t.
    direction = -np.einsum("nji,nj->ni", rotation, translation)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    if not (length > 0.0).all():
        raise DatasetError(f"{files.place}: an instance is at the camera, or its cam_R_m2c is no rotation; {ADVICE}")
    light = cameras[0].light if cameras else None
    return SceneTruth(
        frames=frames,
        counts=np.array([len(each) for each in truth], np.int64),
        object_id=np.array([entry.obj_id for entry in entries], np.int64),
        images=images,
        visibility=np.array([entry.visib_fract for each in infos for entry in each], np.float64),
        direction=direction / length,
        light=None if isinstance(light, UnsetType) else light,
        depth_scale=np.array([np.nan if isinstance(entry.depth_scale, UnsetType) else entry.depth_scale for entry in cameras]),
        files=files,
    )


_Parts = tuple[Sequence[LitCameraEntry], Sequence[Sequence[TruthEntry]], Sequence[Sequence[InfoEntry]]]
"""Entries of each frame in scene_camera.json, scene_gt.json and scene_gt_info.json."""


def _read_folder(files: SceneFolder, frames: int) -> _Parts:
    """Entries of a BOP folder, each file decoded once."""
    schemas = {"camera": LitCameraEntry, "gt": list[TruthEntry], "gt_info": list[InfoEntry]}
    parts = []
    for name, schema in schemas.items():
        path = files.annotations(name)
        content = read_json(path, dict[Key, schema], DatasetError, ADVICE)  # type: ignore[valid-type]
        if content.keys() != set(range(frames)):
            raise DatasetError(f"{path} does not have the images 0 to {frames - 1} of its episode; {ADVICE}")
        parts.append([content[frame] for frame in range(frames)])
    return tuple(parts)


def _read_views(files: SceneFiles, images: Sequence[int]) -> _Parts:
    """Entries of the views in shards, or of a data set that no bake wrote."""
    records = [files.records(image) for image in images]
    cameras = [check_content(record.camera, LitCameraEntry, files.place) for record in records]
    truth = [msgspec.convert(record.gt, list[TruthEntry]) for record in records]
    # What has been measured, or is not known, needs no check, and NaN would not pass it.
    return cameras, truth, [[InfoEntry(**{key: entry[key] for key in _INFO}) for entry in record.gt_info] for record in records]


_INFO = InfoEntry.__struct_fields__
