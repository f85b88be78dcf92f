"""Drawing primitives of all figures: text, colours and labels of instances, picture files, false colours of depth and layers (AOVs)."""

import colorsys
import functools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.dataset.view import read_layer
from synpick_warp.dataset.view_files import SceneFiles
from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import write_atomically
from synpick_warp.system.inputs.files import make_folder

FONT = cv2.FONT_HERSHEY_SIMPLEX
GOLDEN = 0.6180339887498949
"""Golden ratio conjugate (√5 - 1) / 2: multiples modulo 1 are a low-discrepancy sequence for any count."""
INK = (40, 40, 40)
WHITE = (255, 255, 255)
_SUFFIXES = (".png", ".jpg", ".jpeg")

_SMALL = 0.44
"""Font scale of a caption (OpenCV)."""
Color = tuple[int, int, int]
"""Blue, green, red."""
Image = np.ndarray
"""(H, W, 3) uint8, blue first, OpenCV's order."""


def check_picture_name(out: Path) -> None:
    """Raise OutputError unless the file name ends as a PNG or JPEG file."""
    if out.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{out} is not an image file; its name must end in {', '.join(_SUFFIXES)}")


def write_picture(out: Path, picture: Image) -> Path:
    """Write an image in the format of its suffix; its folder is created. Returns the path. Raises OutputError if it cannot be written."""
    try:
        encoded, data = cv2.imencode(out.suffix, picture)
    except cv2.error:
        encoded, data = False, np.empty(0, np.uint8)
    if not encoded:
        raise OutputError(
            f"cannot write {out}: OpenCV cannot encode {picture.shape[1]} x {picture.shape[0]} pixels; use .png or fewer views"
        )
    try:
        make_folder(out.parent)
        if out.is_dir():
            raise OutputError(f"cannot write {out}: it is a folder")
        write_atomically(out, data.tobytes())
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {out}: {getattr(error, 'strerror', None) or error}") from error
    return out


def put_text(image: Image, text: str, place: tuple[int, int], size: float, color: Color, thickness: int = 1) -> None:
    """Draw text; `place` is its lower left corner [px], `size` OpenCV's font scale."""
    # Names of folders and texts of records may have characters that cannot be encoded, or that end OpenCV's string.
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    cv2.putText(image, shown, place, FONT, size, color, thickness, cv2.LINE_AA)


def text_size(text: str, size: float) -> tuple[int, int]:
    """Width and height of a text [px] at OpenCV's font scale `size`."""
    width, height = cv2.getTextSize(text, FONT, size, 1)[0]
    return width, height


def put_lines(image: Image, lines: Iterable[str], place: tuple[int, int], step: int, size: float, color: Color = INK) -> None:
    """Draw lines of text below each other, at a distance of `step` [px]; `place` is the lower left corner of the first."""
    for number, line in enumerate(lines):
        put_text(image, line, (place[0], place[1] + step * number), size, color)


def shorten(text: str, width: float, size: float) -> str:
    """Cut a text to a width [px] at a font scale."""
    if text_size(text, size)[0] <= width:
        return text
    while text and text_size(f"{text}...", size)[0] > width:
        text = text[: -1 - len(text) // 16]
    return f"{text}..."


def blank(width: int, height: int) -> Image:
    """A white image."""
    return np.full((height, width, 3), 255, np.uint8)


def paste(sheet: Image, picture: Image, column: int, row: int) -> None:
    """Copy a picture into a sheet; `column` and `row` are those of its upper left corner."""
    sheet[row : row + picture.shape[0], column : column + picture.shape[1]] = picture


def stacked(rows: Sequence[Image], gap: int = 0) -> Image:
    """Images below each other, each followed by a gap, on white as wide as the widest."""
    width = max(row.shape[1] for row in rows)
    padded = [cv2.copyMakeBorder(row, 0, gap, 0, width - row.shape[1], cv2.BORDER_CONSTANT, value=WHITE) for row in rows]
    return np.concatenate(padded)


def with_text(picture: Image, lines: Sequence[str], height: int, step: int) -> Image:
    """Picture with lines of small text in a white strip of a height [px] below it."""
    strip = blank(picture.shape[1], height)
    put_lines(strip, lines, (4, step - 2), step, _SMALL)
    return np.concatenate([picture, strip])


def instance_color(instance: int) -> Color:
    """Colour of an instance id, the same in all images of an episode; blue first."""
    red, green, blue = colorsys.hsv_to_rgb(instance * GOLDEN % 1.0, 0.85 - 0.3 * (instance % 2), 1.0)
    return round(255 * blue), round(255 * green), round(255 * red)


def readable_on(color: Color) -> Color:
    """Text colour with contrast to a background (blue first): dark or white by luma."""
    blue, green, red = color
    return INK if 0.114 * blue + 0.587 * green + 0.299 * red > 110 else WHITE


def short_labels(objects: Iterable[tuple[int, int]]) -> dict[int, str]:
    """Short label of each (instance id, obj_id): its obj_id, with letters where several instances share it: 9a, 9b, ..., 9z, 9aa.

    Letters number instance ids, so that an instance has the same in every picture, whichever others are there.
    """
    shown = dict(objects)
    counts = Counter(shown.values())
    return {instance: f"{object_id}{_letters(instance) if counts[object_id] > 1 else ''}" for instance, object_id in shown.items()}


def _letters(place: int) -> str:
    """Letters that number a place: a, b, ..., z, aa, ab, ..."""
    return (_letters(place // 26 - 1) if place >= 26 else "") + chr(ord("a") + place % 26)


_RANGE = (1.0, 99.0)
"""Depth percentiles at the ends of the colour map, if no bin defines its range."""
_EVERY = 7
"""Every n-th pixel counts for percentiles."""
MM = 1000.0
"""Millimetres in a metre."""
_MOTION_RANGE = 99.0
"""Percentile of an image's motions that maps to full colour."""
_GREY = 64
"""Grey level of unknown pixels, which differ from static ones."""


class DepthScale(NamedTuple):
    """Colour scale of depth: the depths of the first (near) and the last colour (far) [mm]."""

    near: float
    far: float


def bin_scale(bins: Sequence[BinSizes], cameras: Iterable[Mapping[str, Any]]) -> DepthScale | None:
    """Depths from the nearest corner of the bins' rims to the farthest of their floors, over some cameras; None: a camera has no pose.

    The world of the cameras' records is the bin's frame: origin in the middle of the inner floor, z up.
    """
    corners, depths = np.array([corner for sizes in bins for corner in sizes.inner_corners]), []
    for camera in cameras:
        if "cam_R_w2c" not in camera or "cam_t_w2c" not in camera:
            return None
        axis, offset = np.array(camera["cam_R_w2c"][6:9], float), float(camera["cam_t_w2c"][2])
        depths.append(corners @ axis * MM + offset)
    if not depths:
        return None
    near, far = float(np.min(depths)), float(np.max(depths))
    return DepthScale(near, far) if 0.0 < near < far else None


def pooled_scale(depths: Iterable[np.ndarray]) -> DepthScale | None:
    """Percentiles of all known depths of some images [mm]; None: no surface."""
    known = [depth.ravel()[::_EVERY][depth.ravel()[::_EVERY] > 0] for depth in depths]
    together = np.concatenate(known) if known else np.empty(0)
    if not together.size:
        return None
    near, far = np.percentile(together, _RANGE)
    return DepthScale(float(near), float(far))


def describe_depth(scale: DepthScale | None) -> str:
    """Caption of `color_depth`: the depths of the first and the last colour."""
    return "depth: none" if scale is None else f"depth {scale.near / MM:.3f} (red) to {scale.far / MM:.3f} m (blue); black: none"


def color_depth(depth: np.ndarray, scale: DepthScale | None = None) -> Image:
    """Depth as a TURBO colour map, near red, far blue, no surface black; without a scale that of the image itself."""
    near, far = scale or pooled_scale([depth]) or (0.0, 1.0)
    nearness = np.clip((far - depth) / max(far - near, 1e-9), 0.0, 1.0)
    colored = cv2.applyColorMap(np.rint(255 * nearness).astype(np.uint8), cv2.COLORMAP_TURBO)
    colored[depth == 0] = 0
    return colored


def draw_layer(name: str, values: np.ndarray, depth_scale: DepthScale | None = None) -> tuple[str, Image]:
    """Caption and colours of one layer, from its values as `synpick_warp.dataset.view.read_layer` returns them.

    `depth_scale` is that of depth images beside it, in the unit of the values; None: the image's own.
    """
    if name not in _DEPTHS:
        return _DRAW[name](values)
    return f"{_DEPTHS[name]}: {100.0 * (values == 0).mean():.1f} % holes, black", color_depth(values, depth_scale)


def layer_pictures(files: SceneFiles, frame: int, depth_scale: DepthScale | None) -> list[tuple[str, Image]]:
    """Caption and colours of each layer that a scene has; raises DatasetError if a layer lacks this frame, or the file is damaged."""
    present = [name for name in (*_DRAW, *_DEPTHS) if files.has(name)]
    return [draw_layer(name, read_layer(files, name, frame), depth_scale) for name in present]


def _draw_normals(values: np.ndarray) -> tuple[str, Image]:
    """Normal map in OpenGL's convention: red right, green up, blue towards the camera."""
    colors = (values * np.array([1.0, -1.0, -1.0], np.float32) + 1.0) / 2.0
    colors[~values.any(axis=-1)] = 0.0
    return "normals: red right, green up, blue to the camera", _bytes(colors)


def _draw_classes(values: np.ndarray) -> tuple[str, Image]:
    """Caption and picture of class ids, a hue each; 0, nothing, is black."""
    present = np.unique(values[values > 0])
    hue = (values * GOLDEN) % 1.0
    return f"classes: {len(present)} present", _from_hsv(hue, np.where(values > 0, 1.0, 0.0))


def _draw_flow(values: np.ndarray) -> tuple[str, Image]:
    """Caption and picture of optical flow: hue is direction, saturation length; unknown (NaN) is grey."""
    size = np.hypot(values[..., 0], values[..., 1])
    full = _full_scale(size)
    colors = _from_hsv(np.arctan2(values[..., 1], values[..., 0]) / (2 * np.pi) % 1.0, size / full)
    return f"flow to the image before: up to {full:.1f} px; grey: unknown", _with_unknown(colors, size)


def _draw_scene_flow(values: np.ndarray) -> tuple[str, Image]:
    """Caption and picture of scene flow: x, y, z as red, green, blue around grey; unknown is marked."""
    size = np.linalg.norm(values, axis=-1)
    full = _full_scale(size)
    colors = _bytes((values / full + 1.0) / 2.0)
    return f"scene flow: x, y, z as red, green, blue, up to {1e3 * full:.1f} mm", _with_unknown(colors, size)


def _draw_score(caption: str, values: np.ndarray) -> tuple[str, Image]:
    """Scores 0 to 1 as a VIRIDIS colour map; 0 is black."""
    colors = cv2.applyColorMap(np.rint(255.0 * values).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return caption, np.where((values > 0.0)[..., None], colors, np.uint8(0))


def _full_scale(size: np.ndarray) -> float:
    """Motion that maps to full colour; 1 if nothing moves."""
    known = size[np.isfinite(size) & (size > 0.0)]
    return float(np.percentile(known, _MOTION_RANGE)) if known.size else 1.0


def _with_unknown(colors: Image, size: np.ndarray) -> Image:
    """Replace pixels of unknown motion (NaN) by grey."""
    return np.where(np.isfinite(size)[..., None], colors, np.uint8(_GREY))


def _bytes(colors: np.ndarray) -> Image:
    """Convert red, green, blue from 0 to 1 to bytes, blue first."""
    return np.rint(255.0 * np.clip(np.nan_to_num(colors[..., ::-1]), 0.0, 1.0)).astype(np.uint8)


def _from_hsv(hue: np.ndarray, value: np.ndarray) -> Image:
    """Saturated colours of a hue and a value from 0 to 1."""
    planes = (360.0 * np.nan_to_num(hue), np.ones_like(value), np.clip(np.nan_to_num(value), 0.0, 1.0))
    return _bytes(cv2.cvtColor(np.stack(planes, axis=-1).astype(np.float32), cv2.COLOR_HSV2RGB))


_DRAW: dict[str, Callable[[np.ndarray], tuple[str, Image]]] = {
    "normals": _draw_normals,
    "albedo": lambda values: ("albedo", np.ascontiguousarray(values[..., ::-1])),
    "nocs": lambda values: ("nocs: red x, green y, blue z of the object", _bytes(values)),
    "classes": _draw_classes,
    "flow": _draw_flow,
    "scene_flow": _draw_scene_flow,
    "ir_left": lambda values: ("infrared, left", np.repeat(values[..., None], 3, axis=-1)),
    "ir_right": lambda values: ("infrared, right", np.repeat(values[..., None], 3, axis=-1)),
    "suction_seal": functools.partial(_draw_score, "suction: seal, yellow 1, blue near 0, black 0"),
    "suction_wrench": functools.partial(_draw_score, "suction: wrench, yellow 1, blue near 0, black 0"),
}
_DEPTHS = {"depth_sensor": "depth sensor", "depth_stereo": "stereo depth"}
"""Layers of depth, and their captions."""
