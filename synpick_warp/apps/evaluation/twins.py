"""Paired renderings (twins) of annotated images as a BOP data set: each image's objects, rendered at their poses and pasted over the image
(as in cut-and-paste augmentation: Dwibedi, Misra and Hebert, ICCV 2017).

Image and twin differ in the objects' appearance alone: materials, light, the camera's tone. What a network loses from twins to images is
therefore the appearance gap; what it lacks on twins has other causes. Without a network, their likeness compares them object by object: a
score from 0 to 1 without training, appearance times geometry. The product is that of SADGE (Bartkowiak et al., 2026), which compares
features of trained networks; here both factors are plain statistics.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from synpick_warp._version import __version__
from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.bop.layout import find_models
from synpick_warp.dataset.commit.merge import link_file
from synpick_warp.dataset.commit.writing import lock_folder
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view import View
from synpick_warp.dataset.view_files import SceneFolder
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.online.render import SceneRenderer
from synpick_warp.scenes.types import Camera
from synpick_warp.system.inputs.files import make_folder
from synpick_warp.system.inputs.image_files import decode_picture
from synpick_warp.system.linear_algebra import is_rotation
from synpick_warp.system.progress import Report, ignore_progress

LIGHTNESS = 100.0
"""Distance of black and white in CIELAB, at which colours have nothing in common."""
ROUNDING = 1.0 / (255.0 * 12.0**0.5)
"""Standard deviation of rounding to 8 bits: less detail than this is none."""
DEPTH_TOLERANCE = 0.1
"""Largest deviation of depth that agrees, as a fraction of the object's diameter (Hinterstoisser et al., ACCV 2012)."""
_LEVELS = 255.0
"""Largest value of 8 bits."""
_DETAIL, _LAB = 2, 3
"""Columns of detail, and of the first of three CIELAB coordinates, in features."""


class Appearance(NamedTuple):
    """Statistics of an object's sRGB pixels, in 0..1: mean and standard deviation of grey values, mean saturation (of HSV), and standard
    deviation of grey values less those blurred by 1 px (texture, sharpening, noise)."""

    brightness: float
    contrast: float
    saturation: float
    detail: float


@dataclass(frozen=True)
class Likeness:
    """Comparison of an object in an image and in its twin; without pixels in common both statistics are None, and all factors 0."""

    obj_id: int
    image: Appearance | None
    twin: Appearance | None
    appearance: float
    geometry: float
    score: float


def find_features(color: np.ndarray) -> np.ndarray:
    """Features (H, W, 6) float32 of an image (H, W, 3) uint8: grey value, saturation, detail, and CIELAB."""
    values = color.astype(np.float32) / _LEVELS
    grey, high, low = values.mean(axis=2), values.max(axis=2), values.min(axis=2)
    detail = grey - cv2.GaussianBlur(grey, (0, 0), 1.0)
    return np.dstack([grey, (high - low) / np.maximum(high, 1.0 / _LEVELS), detail, cv2.cvtColor(values, cv2.COLOR_RGB2LAB)])


def measure_appearance(pixels: np.ndarray) -> Appearance:
    """Appearance of pixels, at least one, by their features (n, 6)."""
    grey, saturation, detail = pixels.T[:_LAB]
    return Appearance(*map(float, (grey.mean(), grey.std(), saturation.mean(), detail.std())))


def compare_appearance(image: np.ndarray, twin: np.ndarray) -> float:
    """Appearance similarity of two sets of pixels, in [0, 1], from their features (n, 6): the product of a color term, which decreases with
    the Wasserstein distance between Gaussians fitted to the colors, and the ratio of the standard deviations of detail."""
    (mean, covariance), (other, spread) = ((lab.mean(axis=1), np.cov(lab, bias=True)) for lab in (image.T[_LAB:], twin.T[_LAB:]))
    roots = np.sqrt(np.linalg.eigvals(covariance @ spread).real.clip(0.0)).sum()
    distance = np.sqrt(((mean - other) ** 2).sum() + max(0.0, np.trace(covariance + spread) - 2.0 * roots))
    less, more = sorted(float(pixels[:, _DETAIL].std()) + ROUNDING for pixels in (image, twin))
    return float(max(0.0, 1.0 - distance / LIGHTNESS) * less / more)


def compare_objects(obj_id: int, image: np.ndarray, twin: np.ndarray, geometry: float) -> Likeness:
    """Likeness of an object from the features (n, 6) of its pixels in image and twin, if there are any, and the agreement of geometry."""
    if not len(image):
        return Likeness(obj_id, None, None, 0.0, geometry, 0.0)
    appearance = compare_appearance(image, twin)
    return Likeness(obj_id, measure_appearance(image), measure_appearance(twin), appearance, geometry, appearance * geometry)


def average(found: Iterable[Likeness]) -> list[Likeness]:
    """Means over the likenesses of each object, by obj_id."""
    groups = dict[int, list[Likeness]]()
    for one in found:
        groups.setdefault(one.obj_id, []).append(one)
    return [_mean(index, group) for index, group in sorted(groups.items())]


def _mean(obj_id: int, group: list[Likeness]) -> Likeness:
    pairs = np.array([(one.image, one.twin) for one in group if one.image is not None]).reshape(-1, 2, len(Appearance._fields))
    image, twin = (Appearance(*each) for each in pairs.mean(axis=0).tolist()) if len(pairs) else (None, None)
    appearance, geometry, score = np.mean([(one.appearance, one.geometry, one.score) for one in group], axis=0).tolist()
    return Likeness(obj_id, image, twin, appearance, geometry, score)


def compare_geometry(
    rendered: np.ndarray, depth: np.ndarray, annotated: np.ndarray | None, measured: np.ndarray | None, tolerance: float | None
) -> float:
    """Agreement of a rendered object with an image, from 0 to 1: the share of its annotated visible pixels (H, W) bool that are `rendered`,
    times the share of these whose depth agrees with the measured one up to `tolerance`; depth (H, W) in m, 0: none. What is None, or depth
    that no pixel has in both, is left out. Pixels that something without annotation may hide do not count."""
    overlap, result = rendered if annotated is None else rendered & annotated, 1.0
    if annotated is not None:
        result = np.count_nonzero(overlap) / max(1, np.count_nonzero(annotated))
    if measured is not None and tolerance is not None and (both := overlap & (measured > 0) & (depth > 0)).any():
        result *= (np.abs(measured[both] - depth[both]) <= tolerance).mean()
    return float(result)


UNIT = 1e-3
"""Unit of BOP models [m]."""
JPEG_QUALITY = 95
"""Quality of twins of JPEG images."""
UPRIGHT = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""World to camera where a data set does not say it: up in the image is up."""
BATCH_PIXELS = 2**21
"""Pixels that are rendered at once."""
RECORD = "gap.jsonl"
"""File of the twins with a line for each image: its path, and the likeness of its objects."""
_ROTATION = "cam_R_w2c"
_TURNED = f"images without {_ROTATION} are taken as upright: light comes from above in them"
_HIDDEN = "without mask_visib, objects are drawn over what hides them"
_DEEP = "images of 16 bits a channel are taken as sRGB over their whole range; twins of these have 16 bits, of which 8 are rendered"
_WIDER = 257
"""Largest value of 16 bits, as a multiple of that of 8."""
_DIGITS = 12
"""Hexadecimal digits of the hash in the name of the hidden folder."""


class ImageRecord(msgspec.Struct):
    """Line of RECORD: path of an image, relative to the data set, and the likeness of each of its objects."""

    image: str
    objects: list[Likeness]


class Shot(NamedTuple):
    """Annotated image, of which a twin is rendered."""

    source: Any
    """Where the image comes from; passed through."""
    color: np.ndarray
    """(H, W, 3) uint8."""
    objects: list[tuple[Path, np.ndarray]]
    """For each object, at least one: path of its model [mm] and its object-to-world pose (4, 4) [m]."""
    camera: Camera
    shown: np.ndarray | None = None
    """Mask of the annotated visible pixels (H, W) bool; None: all rendered pixels."""


class Twin(NamedTuple):
    """Twin of an image."""

    shot: Shot
    color: np.ndarray
    """Composite image (H, W, 3) uint8: objects without their outlines are rendered, all other pixels are copied; grey for a grey image."""
    instance: np.ndarray
    """Instance mask (H, W) uint8: 1-based index into `Shot.objects`; 0: background."""
    depth: np.ndarray
    """Planar depth (H, W) float32 [m]; 0: no object."""


def render_twins(shots: Iterable[Shot], renderer: SceneRenderer) -> Iterator[Twin]:
    """Render the twins of images by a renderer of their models, in batches of images of one size."""
    batch = list[Shot]()
    for shot in shots:
        if batch and (shot.color.shape != batch[0].color.shape or len(batch) * shot.color[..., 0].size >= BATCH_PIXELS):
            yield from _render_batch(batch, renderer)
            batch = []
        batch.append(shot)
    if batch:
        yield from _render_batch(batch, renderer)


def _render_batch(shots: Sequence[Shot], renderer: SceneRenderer) -> Iterator[Twin]:
    views = renderer.render([shot.objects for shot in shots], [shot.camera for shot in shots])
    scale = np.float32(UNIT * renderer.settings.bop.depth_scale)
    for shot, color, instance, depth in zip(shots, *(views[name].numpy() for name in ("color", "instance", "depth")), strict=True):
        instance = instance if shot.shown is None else np.where(shot.shown, instance, 0).astype(np.uint8)
        twin = np.where(inner_pixels(instance)[..., None], color, shot.color)
        if (shot.color == shot.color[..., :1]).all():
            twin = cv2.cvtColor(cv2.cvtColor(twin, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        yield Twin(shot, twin, instance, depth * scale)


def inner_pixels(instance: np.ndarray) -> np.ndarray:
    """Pixels of objects (H, W) bool but those at outlines: renderings blend these with a background that the image does not have."""
    return cv2.erode((instance > 0).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0


def write_twins(
    data_set: DataSet, out: Path, settings: Config, report: Report = ignore_progress, note: Callable[[str], object] = print
) -> list[Likeness]:
    """Write the twins of all views of a data set, or of one split, in BOP's folders to the new folder `out`, with all else but other splits
    as links or copies, and RECORD. Returns the likeness of the objects of all views. What an interrupted run has written stays in a hidden
    folder beside `out`; the next one with the same files and settings goes on there. `note` receives what is assumed. Raises SynpickError:
    there are no objects, files are missing or damaged, or a setting cannot be used; headers and annotations are read before any work."""
    out, root, note = out.resolve(), data_set.folder, cache(note)
    if out.is_mount():
        raise OutputError(f"--out is {out}, a mount point, which cannot be renamed to; name a folder in it")
    splits, names, wanted, camera = _check_inputs(data_set, note)
    models = find_models(root, wanted, "twins are rendered")
    files = {index: path for index, (path, _) in models.items()}
    tolerances = {index: None if info.diameter is None else DEPTH_TOLERANCE * info.diameter for index, (_, info) in models.items()}
    renderer = SceneRenderer(list(files.values()), [camera], (), UNIT, settings.bake.device, settings)
    with output_errors(out), ExitStack() as stack:
        paths = _list_files(root, splits)
        states = [(path, state.st_size, state.st_mtime_ns) for path in paths for state in [path.lstat()]]
        content = repr((__version__, root.resolve(), names, states, config_to_toml(settings)))
        work = out.with_name(f".{out.name}-{hashlib.sha256(content.encode()).hexdigest()[:_DIGITS]}")
        make_folder(work)
        stack.callback(os.close, lock_folder(work))
        made = _read_record(work / RECORD)
        try:
            for path in paths:
                if (name := str(path.relative_to(root))) not in made:
                    (work / name).unlink(missing_ok=True)
                    link_file(path, work / name)
            shots = (_make_shot(view, files) for view in _views(data_set) if len(view) and names[_key(view)] not in made)
            with (work / RECORD).open("ab", buffering=0) as record:
                for twin in render_twins(shots, renderer):
                    name = names[_key(twin.shot.source)]
                    _replace(work / name, twin, note)
                    found = _compare(twin, tolerances)
                    record.write(msgspec.json.encode(ImageRecord(name, found)) + b"\n")
                    made[name] = found
                    report("views", len(made), len(names))
            work.rename(out)
        except BaseException:
            if made:
                note(f"{len(made)} twins are kept in {work}; the same command goes on there")
            else:
                shutil.rmtree(work, ignore_errors=True)
            raise
    return [one for objects in made.values() for one in objects]


def _views(data_set: DataSet) -> Iterator[View]:
    """Views camera by camera, whose images have one size mostly; made anew each time, as a view keeps the images that were read."""
    return (view for episode in data_set.values() for camera in episode.cameras for view in episode.views(camera))


def _key(view: View) -> tuple[int, int, int]:
    return view.episode, view.camera, view.image_id


def _check_inputs(data_set: DataSet, note: Callable[[str], object]) -> tuple[set[Path], dict[tuple[int, int, int], str], set[int], Camera]:
    """Folders of the splits; path of the image of each view with objects; their obj_ids; and one of the cameras. Raises DatasetError: there
    are no objects, an image or mask is missing or no image of its camera's size, or annotations cannot be used."""
    splits, names, wanted, remarks, camera = set[Path](), dict[tuple[int, int, int], str](), set[int](), set[str](), None
    scene_files = cache(data_set.scene_files)
    for view in _views(data_set):
        scene = scene_files(view.episode, view.camera)
        if not isinstance(scene, SceneFolder):
            raise DatasetError(f"{scene.place} is a shard; twins are made of data sets in folders: synpick-warp convert")
        if len(view) > MAX_INSTANCES:
            raise DatasetError(f"{view.place}: image {view.image_id} has {len(view)} objects; allowed: {MAX_INSTANCES}")
        splits.add(scene.folder.parent)
        source = Path(scene.image_file("rgb", view.image_id)[2])
        if _has_depth(view):
            scene.image_file("depth", view.image_id)
        for index in range(len(view) if view.has("mask_visib") else 0):
            scene.image_file("mask_visib", view.image_id, index)
        if len(view):
            names[_key(view)], camera = str(source.relative_to(data_set.folder)), _place(view)[0]
        remarks |= {text for known, text in ((_ROTATION in view.records.camera, _TURNED), (view.has("mask_visib"), _HIDDEN)) if not known}
        wanted |= set(view.object_ids.tolist())
    if camera is None:
        raise DatasetError(f"{data_set.folder} has no image with objects in its scene_gt.json, so none has a twin")
    for text in sorted(remarks):
        note(text)
    return splits, names, wanted, camera


def _has_depth(view: View) -> bool:
    return view.has("depth") and "depth_scale" in view.records.camera


def _read_record(path: Path) -> dict[str, list[Likeness]]:
    """Read RECORD of an interrupted run: likenesses by image path. The file is truncated at the first damaged line."""
    made, size = dict[str, list[Likeness]](), 0
    if path.exists():
        with suppress(msgspec.MsgspecError):
            for line in path.read_bytes().split(b"\n")[:-1]:
                record = msgspec.json.decode(line, type=ImageRecord)
                made[record.image] = record.objects
                size += len(line) + 1
        os.truncate(path, size)
    return made


def _list_files(root: Path, splits: set[Path]) -> list[Path]:
    """All files of a data set but RECORD and those of other splits."""
    absent = {path.parent.parent for path in root.glob("*/*/scene_*.json")} - splits
    files = (path for path in sorted(root.rglob("*")) if path.is_symlink() or not path.is_dir())
    return [path for path in files if path != root / RECORD and absent.isdisjoint(path.parents)]


def _place(view: View) -> tuple[Camera, np.ndarray]:
    """Camera of a view, and object to world (N, 4, 4) [m]."""
    if not all(map(is_rotation, view.object_to_camera[:, :3, :3])):
        raise DatasetError(f"{view.place}: an object of image {view.image_id} has a cam_R_m2c that is no rotation")
    placed = view.world_to_camera if _ROTATION in view.records.camera else UPRIGHT
    camera = Camera(*view.size, np.asarray(view.intrinsics), placed[:3, :3], placed[:3, 3], lens=view.lens)
    return camera, np.linalg.inv(placed) @ view.object_to_camera


def _make_shot(view: View, models: Mapping[int, Path]) -> Shot:
    camera, poses = _place(view)
    objects = [(models[int(index)], pose) for index, pose in zip(view.object_ids, poses, strict=True)]
    return Shot(view, view.rgb, objects, camera, np.logical_or.reduce(view.masks) if view.has("mask_visib") else None)


def _compare(twin: Twin, tolerances: Mapping[int, float | None]) -> list[Likeness]:
    """Likeness of the objects of a view that it shows; `tolerances`: of depth, by obj_id [m]; None: depth is not compared."""
    view, inner = twin.shot.source, inner_pixels(twin.instance)
    masks, depth = view.masks if view.has("mask_visib") else [None] * len(view), view.depth if _has_depth(view) else None
    features, found = [find_features(color) for color in (twin.shot.color, twin.color)], list[Likeness]()
    for number, (index, mask) in enumerate(zip(view.object_ids.tolist(), masks, strict=True), 1):
        shown = twin.instance == number
        geometry = compare_geometry(shown, twin.depth, mask, depth, tolerances[index])
        if (pixels := shown & inner).any() or (geometry == 0.0 and mask is not None and mask.any()):
            found.append(compare_objects(index, features[0][pixels], features[1][pixels], geometry))
    return found


def _replace(target: Path, twin: Twin, note: Callable[[str], object]) -> None:
    """Replace a link to an image by its twin, with the channels and bits of the image; the image itself, which has the same data, stays."""
    stored, inner = decode_picture(target.read_bytes(), target, DatasetError), inner_pixels(twin.instance)
    values = twin.color[..., ::-1][inner].astype(stored.dtype)
    if stored.dtype == np.uint16:
        note(_DEEP)
        values *= _WIDER
    if stored.ndim == 2:
        stored[inner] = values[:, 0]
    else:
        stored[..., :3][inner] = values
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if target.suffix.lower().startswith(".j") else []
    target.unlink()
    target.write_bytes(cv2.imencode(target.suffix, stored, quality)[1].tobytes())
