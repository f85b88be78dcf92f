"""Sheet of a cell: a view from outside with frusta, bins, gripper and axes, and the view of each camera with what it covers."""

from __future__ import annotations

import colorsys
import math
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.apps.viz.cell.frusta import Canvas, draw_axes, draw_camera, project, rays
from synpick_warp.apps.viz.cell.rendering import CellScene, scaled_down
from synpick_warp.apps.viz.drawing import GOLDEN, INK, WHITE, Image, blank, check_picture_name, put_text, stacked, with_text, write_picture
from synpick_warp.configs.cell.bins import Bins
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.constants import GRIPPER_HOME

_OUTSIDE = (1040, 780)
"""Size of the view from outside [px]."""
_FOV = 35.0
"""Its horizontal field of view [°]."""
_AZIMUTH, _ELEVATION = -60.0, 22.0
"""Where it is seen from [°]."""
_MARGIN = 0.06
"""Free border of the view from outside, as a fraction of its sides."""
_PYRAMID = 0.1
"""Depth of the camera pyramids, as a fraction of the diameter of the cell."""
_FAR = 3.0
"""Depth to which views are drawn that meet no floor, in sizes of the cell."""
_PANEL, _CAPTION, _LINE, _GAP = 480, 62, 19, 8
"""Longest side of a camera's picture, heights of the text below and of its lines, and gaps [px]."""
_COLUMNS = 3
"""Cameras beside each other."""
MAX_BINS = 4
"""Most bins with a view from outside."""
_MAX_NAMED = 16
"""Most objects that are named."""


def write_cell_sheet(scene: CellScene, rig: Rig, bins: Bins, name: str, out: Path) -> Path:
    """Draw a cell, and write the image file; returns its path.

    Args:
        scene: The cell.
        rig: Its cameras.
        bins: Settings of what stands under them.
        name: What the sheet is of, for its title.
        out: PNG or JPEG file to write; its folder is created.

    Raises:
        ConfigError: A camera's pose is degenerate.
        OutputError: The file cannot be written.
    """
    check_picture_name(out)
    cameras = tuple(scene.placed(camera) for camera in make_cameras(rig))
    outside = _outside_camera(scene, cameras)
    views = [_draw_outside(scene, index, outside, cameras, rig.names) for index in range(len(scene.sizes[:MAX_BINS]))]
    panels = [_draw_camera_view(scene, rig, index, camera) for index, camera in enumerate(cameras)]
    rows = [_row([view, _facts(scene, bins, index, name if index == 0 else "")]) for index, view in enumerate(views)]
    rows += [_row(panels[start : start + _COLUMNS]) for start in range(0, len(panels), _COLUMNS)]
    return write_picture(out, cv2.copyMakeBorder(stacked(rows, _GAP), _GAP, 0, _GAP, _GAP, cv2.BORDER_CONSTANT, value=WHITE))


def _outside_camera(scene: CellScene, cameras: tuple[Camera, ...]) -> Camera:
    """Overview camera whose image contains all cameras, bins and the gripper; a shifted principal point centres them."""
    corners = np.array([corner for one in scene.sizes for corner in one.corners])
    top = (*scene.tcp[:2], scene.tcp[2] + scene.config.gripper.cup_length + scene.config.gripper.finger_length)
    points = np.concatenate([corners, [camera.center for camera in cameras], [scene.tcp, top]])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    azimuth, elevation = math.radians(_AZIMUTH), math.radians(_ELEVATION)
    back = np.array((math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)))
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(-back, right), -back])
    width, height = _OUTSIDE
    focal = width / 2.0 / math.tan(math.radians(_FOV) / 2.0)
    seen = (points - middle) @ rotation.T
    room = np.array(_OUTSIDE) * (1.0 - 2.0 * _MARGIN) / focal
    low, high = 0.0, 100.0 * float(np.ptp(seen, axis=0).max())
    for _ in range(50):
        distance = (low + high) / 2.0
        depth = seen[:, 2] + distance
        fits = depth.min() > 0.0 and bool((np.ptp(seen[:, :2] / depth[:, None], axis=0) <= room).all())
        low, high = (low, distance) if fits else (distance, high)
    flat = seen[:, :2] / (seen[:, 2] + high)[:, None]
    offset = np.array(_OUTSIDE) / 2.0 - focal * (flat.min(axis=0) + flat.max(axis=0)) / 2.0
    matrix = np.array([[focal, 0.0, offset[0]], [0.0, focal, offset[1]], [0.0, 0.0, 1.0]])
    return Camera(width, height, matrix, rotation, -rotation @ (middle + high * back))


def _size_of(cameras: tuple[Camera, ...], scene: CellScene) -> float:
    """Size of a cell [m]: its largest extent."""
    points = [corner for one in scene.sizes for corner in one.corners] + [tuple(camera.center) for camera in cameras]
    return float(np.ptp(np.array(points), axis=0).max())


def _draw_outside(scene: CellScene, index: int, outside: Camera, cameras: tuple[Camera, ...], names: tuple[str, ...]) -> Image:
    """The cell with one of its bins, from outside."""
    canvas, size = Canvas(scene.render(outside, index)), _size_of(cameras, scene)
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        draw_camera(canvas, camera, name, _color(number), size=_PYRAMID * size, floor=scene.sizes[0].origin[2], most=_FAR * size)
    draw_axes(canvas, _round_length(min(scene.sizes[index].floor) / 2.0))
    if index == 0:
        canvas.label(np.array(scene.tcp), "gripper", INK, 0.45, (30, -30))
    return canvas.image()


def _color(index: int) -> tuple[int, int, int]:
    """Colour of a camera, dark enough for a light ground; blue first."""
    red, green, blue = colorsys.hsv_to_rgb(index * GOLDEN % 1.0, 0.95, 0.78)
    return round(255 * blue), round(255 * green), round(255 * red)


def _round_length(length: float) -> float:
    """Round scale length: the largest of 1, 2 and 5 times a power of ten that is at most `length` [m]."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * (1.0 + 1e-9))


def _draw_camera_view(scene: CellScene, rig: Rig, index: int, camera: Camera) -> Image:
    """What a camera sees of the cell with its first bin, in its colour, with what it covers in three lines; on the gripper also of that."""
    picture = scene.render(scaled_down(camera), 0 if rig.moves(index) else -1).color
    name = f"{rig.names[index]} (on the gripper)" if rig.moves(index) else rig.names[index]
    scale = _PANEL / max(camera.resolution)
    size = (max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC if scale > 1.0 else cv2.INTER_AREA)
    cv2.rectangle(picture, (0, 0), (size[0] - 1, size[1] - 1), _color(index), 3)
    picture = cv2.copyMakeBorder(picture, 0, 0, 0, _PANEL - size[0], cv2.BORDER_CONSTANT, value=WHITE)
    return with_text(picture, describe_camera(camera, name, scene.sizes[0]), _CAPTION, _LINE)


def describe_camera(camera: Camera, name: str, bin: BinSizes) -> list[str]:
    """Image, lens, and what a camera sees of a bin, in three lines."""
    width, height = camera.width, camera.height
    ends = np.array([(0.0, height / 2), (width, height / 2), (width / 2, 0.0), (width / 2, height)])
    directions = rays(camera, ends)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    across, down = (math.degrees(math.acos(np.clip(directions[2 * k] @ directions[2 * k + 1], -1.0, 1.0))) for k in (0, 1))
    (fx, fy), (cx, cy) = np.diag(camera.matrix)[:2], camera.matrix[:2, 2]
    lens = "" if camera.lens is None else f", {camera.lens.lens.model} {len(camera.lens.lens.coefficients)} coefficients"
    pixels, depth = project(camera, np.array(bin.inner_corners))
    inside = (depth > 0.0) & (pixels >= 0.0).all(axis=1) & (pixels <= (width, height)).all(axis=1)
    forward = camera.rotation[2]
    distance = (bin.origin[2] - camera.center[2]) / forward[2] if forward[2] < 0.0 else math.inf
    floor = f"{distance:.2f} m to the floor, {1e3 * distance / fx:.2g} mm/px" if distance < math.inf else "looks up"
    return [
        f"{name}: {width} x {height} px, {across:.1f} x {down:.1f} deg",
        f"fx {fx:.1f} fy {fy:.1f} cx {cx:.1f} cy {cy:.1f}{lens}",
        f"{floor}; {inside.sum()} of {len(inside)} corners of the {bin.noun} in view",
    ]


def _facts(scene: CellScene, bins: Bins, index: int, title: str) -> Image:
    """Column of text beside a view from outside."""
    sizes, laid = scene.sizes[index], scene.laid[index]
    lines = [title, ""] if title else []
    lines += [f"{sizes.noun} {sizes.name}" if sizes.name != sizes.noun else sizes.name]
    if sizes.is_visible:
        lines += [f"  outside {_millimetres((*sizes.outer, sizes.height - sizes.base))} mm"]
    lines += [f"  {'floor' if sizes.shell else 'area'} {_millimetres(sizes.floor)} mm"]
    if sizes.shell:
        lines += [f"  opening {_millimetres(sizes.opening)} mm, {1e3 * sizes.height:.0f} mm up"]
    if sizes.turn:
        lines += [f"  turned by {math.degrees(sizes.turn):.4g} deg"]
    shift, yaw = bins.shift, bins.yaw
    if any(shift) or yaw:
        lines += [f"  moves by up to {_millimetres(shift)} mm, {yaw:g} deg"]
    if index == 0:
        gripper = scene.config.gripper
        cups = f"{len(gripper.cups)} cups" if gripper.cups else "cup"
        lines += ["", "gripper", f"  {cups} {1e3 * gripper.cup_width:.0f} mm wide, drawn over the {sizes.noun};"]
        lines += [f"  home, out of view: {GRIPPER_HOME[0]:g}, {GRIPPER_HOME[1]:g}, {GRIPPER_HOME[2]:g} m"]
    lines += ["", f"{len(laid.indices)} of {len(scene.objects)} objects", "  laid out on the floor, not dropped [mm]:"]
    shown = [scene.objects[which] for which in laid.indices[:_MAX_NAMED]]
    lines += [f"  {raw.name[:20]} {_millimetres(np.ptp(raw.mesh.vertices, axis=0))}" for raw in shown]
    if len(laid.indices) > len(shown):
        lines += [f"  and {len(laid.indices) - len(shown)} more"]
    column = blank(_PANEL * _COLUMNS + _GAP * (_COLUMNS - 1) - _OUTSIDE[0] - _GAP, _OUTSIDE[1])
    for row, line in enumerate(lines):
        put_text(column, line, (4, 20 + 21 * row), 0.55 if line == title else 0.46, INK)
    return column


def _millimetres(lengths: object) -> str:
    """Lengths [m] as text in millimetres, such as "615 x 373"."""
    return " x ".join(f"{1e3 * float(length):.0f}" for length in np.asarray(lengths, float))


def _row(images: list[Image]) -> Image:
    """Images beside each other, with gaps."""
    height = max(image.shape[0] for image in images)
    padded = [cv2.copyMakeBorder(image, 0, height - image.shape[0], 0, _GAP, cv2.BORDER_CONSTANT, value=WHITE) for image in images]
    return np.concatenate(padded, axis=1)[:, :-_GAP]
