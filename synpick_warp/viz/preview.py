"""Contact sheet of a BOP data set, from its files: colour, depth colour map, instance masks, bounding boxes and layers of sampled views."""

from __future__ import annotations

import colorsys
import itertools
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.dataset.annotations import SCENE_SCHEMAS, read_checked
from synpick_warp.dataset.view_files import SceneFolder, check_planes, read_image
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.viz.preview_layers import layer_pictures

_PANEL_WIDTH = 480
"""Width of one image on the sheet [px]."""
_MAX_PANEL_HEIGHT = 1920
"""Maximum height of one image on the sheet [px]: tall images become narrower."""
MAX_VIEWS = 200
"""Maximum number of views on a sheet: some 76,000 rows of pixels."""
_CAPTION = 20
"""Height of the caption above an image [px]."""
_GAP = 4
"""Gap between images [px]."""
FONT = cv2.FONT_HERSHEY_SIMPLEX
_GOLDEN = 0.6180339887498949
"""Golden ratio conjugate (√5 - 1) / 2: multiples modulo 1 are a low-discrepancy sequence for any count."""
_SENSOR = re.compile(r"(_[A-Za-z0-9_]+)?")
"""Suffix of a sensor's files; empty: classic layout."""
_SUFFIXES = (".png", ".jpg", ".jpeg")
_DEPTH_RANGE = (1.0, 99.0)
"""Percentiles of the depths that map to the first and the last colour."""

Image = np.ndarray
"""(H, W, 3) uint8, blue first, OpenCV's order."""


class Scene(NamedTuple):
    """A scene as one camera sees it: a folder, or with several sensors the files of one of them."""

    folder: Path
    sensor: str = ""
    """Suffix of the sensor's folders and files, such as "_cam1"; empty: classic layout."""

    def images(self, name: str) -> Path:
        """Folder of one kind of images, such as "rgb"."""
        return self.folder / f"{name}{self.sensor}"

    def annotations(self) -> Path:
        """File of the cameras."""
        return self.folder / f"scene_camera{self.sensor}.json"


@dataclass(frozen=True)
class _View:
    scene: Scene
    frame: int
    depth_scale: float
    """[mm]"""
    truth: list[tuple[dict[str, Any], dict[str, Any]]]
    """Records of scene_gt and scene_gt_info, per instance."""


def write_contact_sheet(dataset: Path, out: Path, views: int) -> Path:
    """Draw sampled views of a data set, one per row, and write the image file.

    Args:
        dataset: Folder of the data set; all its splits are sampled.
        out: PNG or JPEG file to write; its folder is created.
        views: Maximum number of views, spread over cameras, scenes and time; the sheet has no more than the data set.

    Raises:
        DatasetError: The folder is not a data set, or a file is missing or damaged.
        OutputError: The image cannot be written, or has more than MAX_VIEWS views.
    """
    check_picture_name(out)
    if views < 1:
        raise OutputError(f"{views} views requested; a contact sheet has at least 1")
    rows = [_row(view) for view in _read_views(sample(find_scenes(dataset), views))]
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    return write_picture(out, sheet)


def check_picture_name(out: Path) -> None:
    """Raise OutputError unless the file name ends as a PNG or JPEG file."""
    if out.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{out} is not an image file; its name must end in {', '.join(_SUFFIXES)}")


def write_picture(out: Path, picture: Image) -> Path:
    """Write an image in the format of its suffix; its folder is created.

    Raises:
        OutputError: It cannot be written.
    """
    try:
        encoded, data = cv2.imencode(out.suffix, picture)
    except cv2.error:
        encoded, data = False, np.empty(0, np.uint8)
    if not encoded:
        raise OutputError(
            f"cannot write {out}: OpenCV cannot encode {picture.shape[1]} x {picture.shape[0]} pixels; use .png or fewer views"
        )
    partial_file = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.is_dir():
            raise OutputError(f"cannot write {out}: it is a folder")
        try:
            # A link of that name in the data set is replaced, never followed.
            with open(partial_file, "xb") as file:
                file.write(data.tobytes())
            partial_file.replace(out)
        except BaseException:
            partial_file.unlink(missing_ok=True)
            raise
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {out}: {getattr(error, 'strerror', None) or error}") from error
    return out


def find_scenes(dataset: Path) -> list[Scene]:
    """Find the scenes of a data set, of each sensor, sorted.

    Raises:
        DatasetError: There is none.
    """
    if not dataset.is_dir():
        raise DatasetError(f"there is no folder {dataset}; name the folder of a BOP data set")
    files = [path for path in dataset.glob("*/*/scene_camera*.json") if path.parent.name.isdecimal()]
    scenes = sorted(Scene(path.parent, sensor) for path in files if _SENSOR.fullmatch(sensor := path.stem.removeprefix("scene_camera")))
    if not scenes:
        raise DatasetError(f"{dataset} has no complete scene; a BOP data set has folders such as train_pbr/000000 with a scene_camera.json")
    return scenes


def sample(scenes: list[Scene], views: int) -> list[tuple[Scene, int]]:
    """Sample views: (scene, frame), sorted and distinct; all views if no more are there than asked for.

    Cameras in turn; a camera's scenes evenly; within a scene at frames of a low-discrepancy sequence.

    Raises:
        DatasetError: A file is damaged, or no scene has a view.
        OutputError: More views are there and asked for than a sheet shows.
    """
    by_camera: dict[tuple[float, ...], list[tuple[Scene, list[int]]]] = {}
    for scene in scenes:
        cameras = read_checked(scene.annotations(), SCENE_SCHEMAS["camera"])
        if cameras:
            first = cameras[min(cameras)]
            group = by_camera.setdefault((*first.get("cam_R_w2c", ()), *first.get("cam_t_w2c", ())), [])
            group.append((scene, sorted(cameras)))
    groups = list(by_camera.values())
    if not groups:
        raise DatasetError(f"no scene in {scenes[0].folder.parent} has a view; bake the data set again")
    present = sum(len(frames) for group in groups for _, frames in group)
    if min(views, present) > MAX_VIEWS:
        raise OutputError(f"{views} views requested, and the data set has {present}; a contact sheet has at most {MAX_VIEWS}")
    if views >= present:
        return sorted((scene, frame) for group in groups for scene, frames in group for frame in frames)
    samples = set()
    for number in range(views):
        group = groups[number % len(groups)]
        in_group = -(-(views - number % len(groups)) // len(groups))
        scene, frames = group[number // len(groups) * len(group) // in_group]
        samples.add((scene, frames[int((0.5 + number * _GOLDEN) % 1.0 * len(frames))]))
    return sorted(samples)


def _read_views(samples: list[tuple[Scene, int]]) -> Iterator[_View]:
    """Read the annotations of views, which are sorted by scene: those of each scene once."""
    for scene, group in itertools.groupby(samples, key=lambda one: one[0]):
        files = SceneFolder(scene.folder, suffix=scene.sensor)
        for _, frame in group:
            camera, truth, infos = files.records(frame)
            yield _View(scene, frame, float(camera["depth_scale"]), list(zip(truth, infos, strict=True)))


def _row(view: _View) -> Image:
    """Draw all panels of a view side by side."""
    stem = f"{view.frame:06d}"
    folder, sensor = view.scene
    color = read_image(view.scene.images("rgb"), stem, cv2.IMREAD_COLOR)
    size = color.shape[1::-1]
    counts = read_image(view.scene.images("depth"), stem, cv2.IMREAD_UNCHANGED, size)
    depth = check_planes(counts, None, f"{view.scene.images('depth') / stem}.png") * view.depth_scale
    panels: list[tuple[str, Callable[[float], Image]]] = [
        (f"{folder.parent.name}/{folder.name}{sensor.replace('_', ' ', 1)} image {view.frame}", lambda scale: _fit(color, scale)),
        (describe_depth(depth), lambda scale: _fit(color_depth(depth), scale, smooth=False)),
        (_instances_caption(view), lambda scale: _fit(_color_instances(view, color), scale, smooth=False)),
        ("boxes: amodal thin, visible thick; obj_id and visible fraction", lambda scale: _draw_boxes(view, _fit(color, scale), scale)),
    ]
    panels += [(caption, partial(_fit, picture, smooth=False)) for caption, picture in layer_pictures(folder, view.frame, size, sensor)]
    scale = min(_PANEL_WIDTH / size[0], _MAX_PANEL_HEIGHT / size[1])
    return np.concatenate([_captioned(draw(scale), caption) for caption, draw in panels], axis=1)


def _fit(image: Image, scale: float, smooth: bool = True) -> Image:
    """Scale an image to the panel's width; nearest neighbour for ids, masks and colour maps."""
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    fitted = cv2.resize(image, size, interpolation=cv2.INTER_AREA if smooth and scale < 1 else cv2.INTER_NEAREST)
    return np.pad(fitted, ((0, 0), (0, _PANEL_WIDTH - size[0]), (0, 0)))


def _captioned(image: Image, caption: str) -> Image:
    """Add a caption above an image and gaps around it."""
    head = np.zeros((_CAPTION, image.shape[1], 3), np.uint8)
    put_text(head, caption, (4, 14), 0.42, (230, 230, 230))
    return np.pad(np.concatenate((head, image)), ((0, _GAP), (0, _GAP), (0, 0)))


def put_text(image: Image, text: str, place: tuple[int, int], size: float, color: tuple[int, int, int], thickness: int = 1) -> None:
    """Draw text; `place` is its lower left corner [px], `size` OpenCV's font scale."""
    # Names of folders and texts of records may have characters that cannot be encoded, or that end OpenCV's string.
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    cv2.putText(image, shown, place, FONT, size, color, thickness, cv2.LINE_AA)


def _depth_limits(depth: np.ndarray) -> tuple[float, float] | None:
    """Depth range of the colour map [mm]; None: no surface."""
    known = depth[depth > 0]
    if not known.size:
        return None
    low, high = np.percentile(known, _DEPTH_RANGE)
    return float(low), float(high)


def describe_depth(depth: np.ndarray) -> str:
    """Caption of `color_depth`: the depths of the first and the last colour; depth [mm]."""
    limits = _depth_limits(depth)
    return "depth: none" if limits is None else f"depth {limits[0] / 1000:.3f} (red) to {limits[1] / 1000:.3f} m (blue); black: none"


def color_depth(depth: np.ndarray) -> Image:
    """Depth as a TURBO colour map, near red, far blue, no surface black."""
    low, high = _depth_limits(depth) or (0.0, 1.0)
    nearness = np.clip((high - depth) / max(high - low, 1e-9), 0.0, 1.0)
    colored = cv2.applyColorMap(np.rint(255 * nearness).astype(np.uint8), cv2.COLORMAP_TURBO)
    colored[depth == 0] = 0
    return colored


def _instances_caption(view: _View) -> str:
    seen = sum(info["px_count_visib"] > 0 for _, info in view.truth)
    return f"instances: {len(view.truth)}, of which {seen} seen"


def _color_instances(view: _View, color: Image) -> Image:
    """Visible masks in their instances' colours over the darkened grey image."""
    grey = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY) // 3
    drawn = np.repeat(grey[..., None], 3, axis=2)
    folder = view.scene.images("mask_visib")
    if not folder.is_dir():
        put_text(drawn, "no masks in this data set", (8, 24), 0.5, (230, 230, 230))
        return drawn
    for index, (record, _) in enumerate(view.truth):
        mask = read_image(folder, f"{view.frame:06d}_{index:06d}", cv2.IMREAD_GRAYSCALE, color.shape[1::-1])
        drawn[mask > 0] = instance_color(record.get("instance_id", index))
    return drawn


def instance_color(instance: int) -> tuple[int, int, int]:
    """Colour of an instance id, the same in all images of an episode; blue first."""
    red, green, blue = colorsys.hsv_to_rgb(instance * _GOLDEN % 1.0, 0.85 - 0.3 * (instance % 2), 1.0)
    return round(255 * blue), round(255 * green), round(255 * red)


def _draw_boxes(view: _View, image: Image, scale: float) -> Image:
    """Draw amodal and visible bounding boxes with object id and visible fraction, in place."""
    for index, (record, info) in enumerate(view.truth):
        if info["px_count_visib"] == 0:
            continue
        color = instance_color(record.get("instance_id", index))
        for name, thickness in (("bbox_obj", 1), ("bbox_visib", 2)):
            x, y, width, height = info[name]
            # BOP's boxes end with their last pixel; OpenCV takes corner coordinates, hence + 1.
            first, second = ((round(scale * u), round(scale * v)) for u, v in ((x, y), (x + width + 1, y + height + 1)))
            cv2.rectangle(image, first, second, color, thickness)
        x, y = info["bbox_visib"][:2]
        place = (max(0, round(scale * x) + 3), max(10, round(scale * y) + 11))
        text = f"{record['obj_id']}: {info['visib_fract']:.2f}"
        cv2.putText(image, text, place, FONT, 0.36, (0, 0, 0), 3, cv2.LINE_AA)
        put_text(image, text, place, 0.36, (255, 255, 255))
    return image
