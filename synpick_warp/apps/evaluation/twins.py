"""Paired renderings (twins) of annotated images as a BOP data set: each image's objects, rendered at their poses and pasted over the image
(as in cut-and-paste augmentation: Dwibedi, Misra and Hebert, ICCV 2017).

Image and twin differ in the objects' appearance alone: materials, light, the camera's tone. What a network loses from twins to images is
therefore the appearance gap; what it lacks on twins has other causes. Without a network, tone and detail are compared object by object.
"""

import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from synpick_warp.codes import MAX_INSTANCES
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
from synpick_warp.system.inputs.files import make_folder
from synpick_warp.system.linear_algebra import det, is_orthonormal
from synpick_warp.system.progress import Report, ignore_progress

UNIT = 1e-3
"""Unit of BOP models [m]."""
JPEG_QUALITY = 95
"""Quality of twins of JPEG images."""
UPRIGHT = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""World to camera where a data set does not say it: up in the image is up."""
_LEVELS = 255.0
_ROTATION = "cam_R_w2c"
_TURNED = f"images without {_ROTATION} are taken as upright: light comes from above in them"
_HIDDEN = "without mask_visib, objects are drawn over what hides them"


class Appearance(NamedTuple):
    """Statistics of an object's sRGB pixels, in 0..1: mean and standard deviation of grey values, mean saturation (of HSV), and standard
    deviation of grey values less those blurred by 1 px (texture, sharpening, noise)."""

    brightness: float
    contrast: float
    saturation: float
    detail: float


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
    uint8, from 1; 0: none. `objects`: model file [mm], and object to world (4, 4) [m], of each, at least one; `shown` (H, W) bool: where
    objects are visible in the image; None: wherever they are rendered. Raises SynpickError: a model or a setting cannot be used."""
    views = render_scene(objects, [camera], (), UNIT, settings.bake.device, settings)
    instance = views["instance"].numpy()[0]
    if shown is not None:
        instance = np.where(shown, instance, 0).astype(np.uint8)
    return np.where(inner_pixels(instance)[..., None], views["color"].numpy()[0], color), instance


def inner_pixels(instance: np.ndarray) -> np.ndarray:
    """Pixels of objects (H, W) bool but those at outlines: renderings blend these with a background that the image does not have."""
    return cv2.erode((instance > 0).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0


def write_twins(
    data_set: DataSet, out: Path, settings: Config, report: Report = ignore_progress, note: Callable[[str], object] = print
) -> dict[int, tuple[Appearance, Appearance]]:
    """Write the twins of all views of a data set, or of one split, in BOP's folders to the new folder `out`, with all else but other splits
    as links or copies. Returns the mean appearance of each obj_id in images and in twins, inside of outlines, over the views that show it.
    `note` receives what is assumed. Raises SynpickError: there are no objects, files are missing or damaged, or a setting cannot be used;
    then there is no folder."""
    scenes, wanted, count, out = dict[tuple[int, int], SceneFolder](), set[int](), 0, out.resolve()
    remarks = set[str]()
    for view in data_set.views():
        if (key := (view.episode, view.camera)) not in scenes:
            scene = data_set.scene_files(*key)
            if not isinstance(scene, SceneFolder):
                raise DatasetError(f"{scene.place} is a shard; twins are made of data sets in folders: synpick-warp convert")
            scenes[key] = scene
        if len(view) > MAX_INSTANCES:
            raise DatasetError(f"{view.place}: image {view.image_id} has {len(view)} objects; allowed: {MAX_INSTANCES}")
        remarks |= {text for known, text in ((_ROTATION in view.records.camera, _TURNED), (view.has("mask_visib"), _HIDDEN)) if not known}
        wanted, count = wanted | set(view.object_ids.tolist()), count + 1
    if not wanted:
        raise DatasetError(f"{data_set.folder} has no image with objects in its scene_gt.json, so none has a twin")
    models = find_models(data_set.folder, wanted, "twins are rendered")
    for text in sorted(remarks):
        note(text)
    found: dict[int, list[tuple[Appearance, Appearance]]] = {}
    root, own = data_set.folder, {scene.folder.parent for scene in scenes.values()}
    others = {path.parent.parent for path in root.glob("*/*/scene_*.json")} - own
    with output_errors(out):
        make_folder(out.parent)
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
        try:
            for path in sorted(root.rglob("*")):
                if others.isdisjoint(path.parents) and (path.is_symlink() or not path.is_dir()):
                    link_file(path, part / path.relative_to(root))
            for done, view in enumerate(data_set.views(), 1):  # Made anew: a view keeps the images that were read.
                suffix, _, source = scenes[view.episode, view.camera].image_file("rgb", view.image_id)
                if len(view):
                    twin, pairs = _make_twin(view, [models[int(index)][0] for index in view.object_ids], settings)
                    _replace(part / Path(source).relative_to(root), suffix, twin)
                    for index, pair in pairs:
                        found.setdefault(index, []).append(pair)
                report("views", done, count)
            part.chmod(root.stat().st_mode)
            part.rename(out)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
    means = {index: np.mean(pairs, axis=0).tolist() for index, pairs in sorted(found.items())}
    return {index: (Appearance(*real), Appearance(*twin)) for index, (real, twin) in means.items()}


def _make_twin(view: View, models: Sequence[Path], settings: Config) -> tuple[np.ndarray, list[tuple[int, tuple[Appearance, Appearance]]]]:
    """Twin (H, W, 3) uint8 of a view, grey if the image is; obj_id and appearance in both of each object that it shows."""
    placed, color = view.world_to_camera if _ROTATION in view.records.camera else UPRIGHT, view.rgb
    if not all(is_orthonormal(pose) and det(pose) > 0 for pose in view.object_to_camera[:, :3, :3]):
        raise DatasetError(f"{view.place}: an object of image {view.image_id} has a cam_R_m2c that is no rotation")
    camera = Camera(*view.size, np.asarray(view.intrinsics), placed[:3, :3], placed[:3, 3], lens=view.lens)
    shown = np.logical_or.reduce(view.masks) if view.has("mask_visib") else None
    objects = zip(models, np.linalg.inv(placed) @ view.object_to_camera, strict=True)
    twin, instance = render_twin(color, list(objects), camera, settings, shown)
    if (color == color[..., :1]).all():
        twin = cv2.cvtColor(cv2.cvtColor(twin, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    masks = [(int(index), (instance == number) & inner_pixels(instance)) for number, index in enumerate(view.object_ids, 1)]
    return twin, [(index, (measure_appearance(color, mask), measure_appearance(twin, mask))) for index, mask in masks if mask.any()]


def _replace(target: Path, suffix: str, twin: np.ndarray) -> None:
    """Replace a link to an image by its twin (H, W, 3) uint8; the image itself, which has the same data, stays."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if suffix.startswith(".j") else []
    target.unlink()
    stored = twin[..., 0] if target.parent.name.startswith("gray") else twin[..., ::-1]
    target.write_bytes(cv2.imencode(suffix, stored, quality)[1].tobytes())
