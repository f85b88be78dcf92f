"""Ground truth of a scene as columns: a row per instance and image, read from annotations alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from synpick_warp.dataset.annotations import ADVICE, InfoEntry, Key, TruthEntry, check_content
from synpick_warp.dataset.view_files import SceneFiles, SceneFolder
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import read_json

_INFO = InfoEntry.__struct_fields__


@dataclass(frozen=True, eq=False)
class SceneArrays:
    """F images of a scene, and N instances in all of them together, in the order of images and ground-truth indices."""

    images: np.ndarray
    """im_id (F,) int64."""
    cameras: Sequence[Any]
    """Entry of each image in scene_camera.json, as the schema given to `read_arrays`."""
    row: np.ndarray
    """Index of each instance's image among these (N,) int64."""
    object_id: np.ndarray
    """obj_id (N,) int64."""
    instance: np.ndarray
    """Instance id (N,) int64; -1: it has none. See `SceneFiles.instance_ids`."""
    tracked: bool
    """Whether the annotations have the instance ids, so that instances can be followed from image to image."""
    rotation: np.ndarray
    """Object to camera (N, 3, 3) float64."""
    translation: np.ndarray
    """(N, 3) float64 [mm]."""
    visibility: np.ndarray
    """Visible fraction (N,) float64; NaN: it is not known."""
    box: np.ndarray
    """Box of the visible part (N, 4) int64 [px]: x, y, width, height, as BOP has them; -1: nothing is visible."""

    def __len__(self) -> int:
        """Number of instances N."""
        return len(self.object_id)

    @property
    def counts(self) -> np.ndarray:
        """Instances of each image (F,) int64."""
        return np.bincount(self.row, minlength=len(self.images))

    def require_instances(self, place: object) -> None:
        """Raise DatasetError if an instance has no id; `place` is named in the message."""
        missing = np.flatnonzero(self.instance < 0)
        if len(missing):
            raise DatasetError(f"{place}: an instance of image {self.images[self.row[missing[0]]]} has no instance_id; {ADVICE}")


def read_arrays(files: SceneFiles, images: Sequence[int], camera: Any = None, *, whole: bool = False) -> SceneArrays:
    """Read the ground truth of some images (im_id) of a scene, with cameras of a schema, None: that of the scene. `whole`: whether
    annotations of a bake must have these images and no others. Raises DatasetError if a file is missing or damaged, or lacks an image."""
    camera = camera or files.schemas["camera"]
    if isinstance(files, SceneFolder) and files.complete:
        cameras, truth, infos = _read_folder(files, images, camera, whole)
    else:
        cameras, truth, infos = _read_views(files, images, camera)
    for image, entries, found in zip(images, truth, infos, strict=True):
        if len(entries) != len(found):
            raise DatasetError(f"{files.place}: image {image} has other instances in scene_gt than in scene_gt_info; {ADVICE}")
    entries = [entry for each in truth for entry in each]
    details = [info for each in infos for info in each]
    ids = [files.instance_ids([(one.obj_id, one.instance_id) for one in each]) or [-1] * len(each) for each in truth]
    return SceneArrays(
        images=np.array(images, np.int64),
        cameras=cameras,
        row=np.repeat(np.arange(len(images)), [len(each) for each in truth]),
        object_id=np.array([entry.obj_id for entry in entries], np.int64),
        instance=np.array([instance for each in ids for instance in each], np.int64),
        tracked=all(entry.instance_id is not UNSET for entry in entries),
        rotation=np.reshape(np.array([entry.cam_R_m2c for entry in entries], np.float64), (-1, 3, 3)),
        translation=np.reshape(np.array([entry.cam_t_m2c for entry in entries], np.float64), (-1, 3)),
        visibility=np.array([info.visib_fract for info in details], np.float64),
        box=np.reshape(np.array([info.bbox_visib for info in details], np.int64), (-1, 4)),
    )


_Parts = tuple[list[Any], list[list[TruthEntry]], list[list[InfoEntry]]]
"""Entries of each image in scene_camera.json, scene_gt.json and scene_gt_info.json."""


def _read_folder(files: SceneFolder, images: Sequence[int], camera: Any, whole: bool) -> _Parts:
    """Entries of a folder of a bake; each file is decoded once."""
    parts = []
    for name, schema in (("camera", camera), ("gt", list[TruthEntry]), ("gt_info", list[InfoEntry])):
        path = files.annotations(name)
        content = read_json(path, dict[Key, schema], DatasetError, ADVICE)
        if whole and content.keys() != set(images):
            raise DatasetError(f"{path} does not have the images 0 to {len(images) - 1} of its episode; {ADVICE}")
        missing = next((image for image in images if image not in content), None)
        if missing is not None:
            names = "scene_camera.json, scene_gt.json and scene_gt_info.json"
            raise DatasetError(f"{files.place}: {names} do not agree about image {missing}")
        parts.append([content[image] for image in images])
    return tuple(parts)


def _read_views(files: SceneFiles, images: Sequence[int], camera: Any) -> _Parts:
    """Entries of the views in shards, or of a scene from another source."""
    records = [files.records(image) for image in images]
    cameras = [check_content(record.camera, camera, files.place) for record in records]
    truth = [msgspec.convert(record.gt, list[TruthEntry]) for record in records]
    # A missing scene_gt_info is filled in with measured values, or NaN where nothing is known, which the schema would refuse.
    return cameras, truth, [[InfoEntry(**{key: entry[key] for key in _INFO}) for entry in record.gt_info] for record in records]
