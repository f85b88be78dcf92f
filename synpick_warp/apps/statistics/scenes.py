"""Ground truth of one scene as arrays, read from a BOP folder or from shards; images are not read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import UNSET, UnsetType

from synpick_warp.apps.statistics.records import Light, LitCameraEntry
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.bop.arrays import read_arrays
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view_files import SceneFiles
from synpick_warp.errors import DatasetError


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """Annotations of a scene of F frames with N instances in all: obj_id, visible fraction (NaN: not known), unit direction from object to
    camera in the object's frame, light (None: not told), depth scales [mm], files.
    """

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
    images = files.frames() if files.lenient else data_set[episode].images(camera)
    arrays = read_arrays(files, images, LitCameraEntry, whole=True)
    # The camera is at the origin: R d = -t.
    direction = -np.einsum("nji,nj->ni", arrays.rotation, arrays.translation)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    if not (length > 0.0).all():
        raise DatasetError(f"{files.place}: an instance is at the camera, or its cam_R_m2c is no rotation; {ADVICE}")
    light = arrays.cameras[0].light if arrays.cameras else UNSET
    return SceneTruth(
        frames=len(images),
        counts=arrays.counts,
        object_id=arrays.object_id,
        images=images,
        visibility=arrays.visibility,
        direction=direction / length,
        light=None if isinstance(light, UnsetType) else light,
        depth_scale=np.array([np.nan if entry.depth_scale is UNSET else entry.depth_scale for entry in arrays.cameras]),
        files=files,
    )
