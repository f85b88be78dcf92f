"""Paired renderings (twins) of annotated images as a BOP data set: each image's objects, rendered at their poses and pasted over the image
(as in cut-and-paste augmentation: Dwibedi, Misra and Hebert, ICCV 2017).

Image and twin differ in the objects' appearance alone: materials, light, the camera's tone. What a network loses from twins to images is
therefore the appearance gap; what it lacks on twins has other causes. Without a network, tone and detail are compared object by object.
"""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.dataset.bop.layout import find_models
from synpick_warp.dataset.commit.merge import link_file
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view import View
from synpick_warp.dataset.view_files import SceneFolder
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.online.render import render_scene
from synpick_warp.scenes.types import Camera
from synpick_warp.system.progress import Report, ignore_progress

UNIT = 1e-3
"""Unit of BOP models [m]."""
JPEG_QUALITY = 95
"""Quality of twins of JPEG images."""
_LEVELS = 255.0
_COLOR_FOLDERS = ("rgb", "rgb_*", "gray", "gray_*")
"""Folders of images that have twins; all else is linked or copied."""


class Appearance(NamedTuple):
    """Statistics of an object's sRGB pixels, in 0..1."""

    brightness: float
    """Mean of the grey values."""
    contrast: float
    """Their standard deviation."""
    saturation: float
    """Mean saturation (of HSV)."""
    detail: float
    """Standard deviation of the grey values less those blurred by 1 px: texture, sharpening, noise."""


def measure_appearance(color: np.ndarray, mask: np.ndarray) -> Appearance:
    """Appearance of the pixels of a mask (H, W) bool, at least one, in an image (H, W, 3) uint8."""
    values = color.astype(np.float32) / _LEVELS
    grey, high, low = values.mean(axis=2), values.max(axis=2), values.min(axis=2)
    detail, saturation = grey - cv2.GaussianBlur(grey, (0, 0), 1.0), (high - low) / np.maximum(high, 1.0 / _LEVELS)
    numbers = grey[mask].mean(), grey[mask].std(), saturation[mask].mean(), detail[mask].std()
    return Appearance(*map(float, numbers))


def render_twin(
    color: np.ndarray, objects: Sequence[tuple[Path, np.ndarray]], camera: Camera, settings: Config, shown: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Twin (H, W, 3) uint8 of an image, in which outlines stay as they are, and the number of the object that each pixel shows (H, W)
    uint8, from 1; 0: none.

    `objects`: model file [mm], and object to world (4, 4) [m], of each, at least one; `shown` (H, W) bool: where objects are visible in
    the image; None: wherever they are rendered. Raises SynpickError: a model or a setting cannot be used."""
    views = render_scene(objects, [camera], (), UNIT, settings.bake.device, settings)
    instance = views["instance"].numpy()[0]
    if shown is not None:
        instance = np.where(shown, instance, 0).astype(np.uint8)
    # Pixels at an outline blend with the background, which the image does not have.
    inside = cv2.erode((instance > 0).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    return np.where(inside[..., None], views["color"].numpy()[0], color), instance


def write_twins(
    data_set: DataSet, out: Path, settings: Config, report: Report = ignore_progress
) -> dict[int, tuple[Appearance, Appearance]]:
    """Write the twins of all views of a data set in BOP's folders to the new folder `out`, with all else as links or copies. Returns the
    mean appearance of each obj_id in images and in twins, over the views that show it.

    Raises SynpickError: files are missing or damaged, or a setting cannot be used; then there is no folder."""
    views = list(data_set.views())
    models = find_models(data_set.folder, {int(index) for view in views for index in view.object_ids}, "twins are rendered")
    found: dict[int, list[tuple[Appearance, Appearance]]] = {}
    with output_errors(out):
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.absolute().parent))
        try:
            for path in sorted(data_set.folder.rglob("*")):
                if not path.is_dir() and not any(fnmatch(path.parent.name, name) for name in _COLOR_FOLDERS):
                    link_file(path, part / path.relative_to(data_set.folder))
            for done, view in enumerate(views, 1):
                _write_twin(data_set, view, {index: path for index, (path, _) in models.items()}, part, settings, found)
                report("views", done, len(views))
            part.chmod(data_set.folder.stat().st_mode)
            part.rename(out)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
    return {index: _means(pairs) for index, pairs in sorted(found.items())}


def _write_twin(data_set: DataSet, view: View, models: Mapping[int, Path], out: Path, settings: Config, found: dict[int, Any]) -> None:
    """Write the twin of a view below `out`, and append the appearance of each of its objects in both to `found`."""
    scene = data_set.scene_files(view.episode, view.camera)
    if not isinstance(scene, SceneFolder):
        raise DatasetError(f"{scene.place} is a shard; twins are made of data sets in folders: synpick-warp convert")
    suffix, content = scene.image_file("rgb", view.image_id)
    folder = out / scene.images("rgb").relative_to(data_set.folder)
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{view.image_id:06d}{suffix}"
    if not len(view):
        target.write_bytes(content)
        return
    placed = view.world_to_camera
    camera = Camera(*view.size, np.asarray(view.intrinsics), placed[:3, :3], placed[:3, 3], lens=view.lens)
    objects = [(models[int(index)], pose) for index, pose in zip(view.object_ids, view.object_to_world, strict=True)]
    shown = np.logical_or.reduce(view.masks) if view.has("mask_visib") else None
    twin, instance = render_twin(view.rgb, objects, camera, settings, shown)
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if suffix.startswith(".j") else []
    target.write_bytes(cv2.imencode(suffix, twin[..., ::-1], quality)[1].tobytes())
    for number, index in enumerate(view.object_ids, 1):
        if (mask := instance == number).any():
            pair = measure_appearance(view.rgb, mask), measure_appearance(twin, mask)
            found.setdefault(int(index), []).append(pair)


def _means(pairs: Sequence[tuple[Appearance, Appearance]]) -> tuple[Appearance, Appearance]:
    real, twin = np.mean(np.array(pairs), axis=0)
    return Appearance(*map(float, real)), Appearance(*map(float, twin))
