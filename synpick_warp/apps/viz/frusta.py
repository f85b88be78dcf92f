"""Cameras of a cell: projection, poses to start from, and a wireframe overlay on a rendered view with a depth test: camera frusta to scale,
their footprints and axes; hidden lines are faint."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import Color, Image, put_text, text_size
from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.cell.cameras import CameraRow, Cameras, Pose, Rig
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.configs.episodes.manipulation import Pick
from synpick_warp.scenes.cameras import is_in_way, make_cameras
from synpick_warp.scenes.types import Camera

_STEP = 4.0
"""Length of the line segments whose visibility is tested [px]."""
_SLACK = 0.004
"""Depth bias of the visibility test, relative to the distance of the point."""
_NEAR = 0.05
"""Near plane of the drawing [m]."""
_FAINT = 0.3
"""Opacity of hidden lines."""
_EDGE = 12
"""Samples per side of the image border; the rays through them outline the camera's footprint on the floor."""
_SHIFT = 4
"""Fractional bits of OpenCV's coordinates."""
_WIDE = 1.3
"""Maximum ratio of edge length to depth of a drawn frustum; those of wide-angle lenses are drawn shorter."""
_LIFT = 1e-3
"""Height of footprints over the floor [m]."""
_DIRECTIONS = ((90.0, 90.0), (-90.0, 55.0), (90.0, 55.0), (0.0, 55.0), (180.0, 55.0), (-45.0, 55.0), (135.0, 55.0))
"""Azimuth and elevation from which the cameras look at the bin [°]: the first from above."""
_LOWER, _LOWEST = 5.0, 40.0
"""Elevations at which a camera is tried that would stand in the gripper's way, and the lowest [°]."""
_FARTHEST, _BORDER = 20.0, 0.05
"""Largest distance of a camera [m], and free border of its image around the bin, as a fraction of its sides."""


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projected pixels (n, 2) and depths (n) [m] of world points (n, 3), with lens distortion; NaN for points behind the camera."""
    seen = np.asarray(points, float) @ camera.rotation.T + camera.translation
    depth = seen[:, 2]
    flat = seen[:, :2] / np.where(depth > 0.0, depth, np.nan)[:, None]
    if camera.lens is not None:
        flat[depth > 0.0] = camera.lens.project(flat[depth > 0.0])
        return flat, depth
    return flat * np.diag(camera.matrix)[:2] + camera.matrix[:2, 2], depth


def rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """World-space rays (n, 3) through pixels (n, 2), scaled to planar depth 1."""
    plain = (pixels - camera.matrix[:2, 2]) / np.diag(camera.matrix)[:2]
    flat = plain if camera.lens is None else camera.lens.unproject(pixels)
    return np.column_stack([flat, np.ones(len(flat))]) @ camera.rotation


def image_border(camera: Camera, points: int = _EDGE) -> np.ndarray:
    """Points (4 points, 2) along the border of an image, clockwise from its top left corner [px]."""
    along = np.arange(points) / points
    sides = [(along, 0 * along), (0 * along + 1, along), (1 - along, 0 * along + 1), (0 * along, 1 - along)]
    return np.concatenate([np.column_stack(side) for side in sides]) * camera.resolution


def footprint(camera: Camera, height: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of an image's border meet a horizontal plane (n, 3), and whether they do within a depth of `most` [m]; of the others,
    the point at that depth."""
    at, along = camera.center, rays(camera, image_border(camera))
    with np.errstate(divide="ignore"):
        depth = np.where(along[:, 2] < 0.0, (height - at[2]) / along[:, 2], np.inf)
    meets = (depth > 0.0) & (depth <= most)
    return at + along * np.where(meets, depth, most)[:, None], meets


def pose_for(row: CameraRow, index: int, sizes: BinSizes) -> Pose:
    """Pose from which a camera sees all of a bin, as near as it can: the first from above, the others from the sides, as steep as they can
    without standing in the gripper's way."""
    azimuth, elevation = _DIRECTIONS[index % len(_DIRECTIONS)]
    up = (0.0, 1.0, 0.0) if index % len(_DIRECTIONS) == 0 else (0.0, 0.0, 1.0)
    while True:
        pose = _nearest(row, math.radians(azimuth), math.radians(elevation), up, sizes)
        if elevation <= _LOWEST or not is_in_way(pose.position or (), sizes, Gripper(), Pick()):
            return pose
        elevation -= _LOWER


def _nearest(row: CameraRow, azimuth: float, elevation: float, up: tuple[float, float, float], sizes: BinSizes) -> Pose:
    """Pose in a direction [rad] from which a camera sees all of a bin, as near as it can."""
    back = (math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation))
    target = (0.0, 0.0, round(sizes.height / 2.0, 3))

    def pose(distance: float) -> Pose:
        x, y, z = (round(end + distance * step, 3) + 0.0 for end, step in zip(target, back, strict=True))
        return Pose(position=(x, y, z), look_at=target, up=up)

    near, far = 0.6 * math.hypot(*sizes.outer, sizes.height - sizes.base), _FARTHEST
    while far - near > 1e-3:
        middle = (near + far) / 2.0
        (camera,) = make_cameras(Rig.of(Cameras(), (replace(row, pose=pose(middle)),)))
        pixels, depth = project(camera, np.array(sizes.corners))
        border = _BORDER * np.array(camera.resolution)
        fits = (depth > 0.0).all() and (pixels >= border).all() and (pixels <= camera.resolution - border).all()
        near, far = (near, middle) if fits else (middle, far)
    return pose(far)


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered view."""

    camera: Camera
    color: np.ndarray
    """(H, W, 3) uint8, blue first."""
    depth: np.ndarray
    """Planar depth (H, W) float32 [m]; 1e30: nothing is hit."""


class Canvas:
    """A rendered view to draw into; `image` finishes it."""

    def __init__(self, picture: Picture) -> None:
        self.picture = picture
        self._lines: list[tuple[np.ndarray, bool, Color, int]] = []
        """Ends [px], whether nothing hides it, colour and width of each piece."""
        self._labels: list[tuple[np.ndarray, str, Color, float, tuple[int, int]]] = []

    def line(self, start: np.ndarray, stop: np.ndarray, color: Color, width: int = 1, *, on_top: bool = False) -> None:
        """A straight line between two points of the world [m]; `on_top`: surfaces do not hide it."""
        camera = self.picture.camera
        ends = np.stack([start, stop]).astype(float)
        depth = ends @ camera.rotation[2] + camera.translation[2]
        if depth.max() <= _NEAR:
            return
        if depth.min() < _NEAR:
            # Cut off what is behind the camera.
            share = (_NEAR - depth[0]) / (depth[1] - depth[0])
            ends[int(depth.argmin())] = ends[0] + share * (ends[1] - ends[0])
        pixels = project(camera, ends)[0]
        pieces = int(np.clip(np.linalg.norm(pixels[1] - pixels[0]) / _STEP, 1, 2000))
        points = ends[0] + np.linspace(0.0, 1.0, 2 * pieces + 1)[:, None] * (ends[1] - ends[0])
        places, depths = project(camera, points)
        for index in range(0, 2 * pieces, 2):
            seen = on_top or self._seen(places[index + 1], depths[index + 1])
            self._lines.append((places[[index, index + 2]], seen, color, width))

    def path(self, points: np.ndarray, color: Color, width: int = 1, *, closed: bool = False) -> None:
        """Straight lines between points (n, 3) [m]."""
        for start, stop in zip(points, np.roll(points, -1, axis=0) if closed else points[1:], strict=closed):
            self.line(start, stop, color, width)

    def label(self, point: np.ndarray, text: str, color: Color, size: float = 0.5, offset: tuple[int, int] = (6, -6)) -> None:
        """Text beside a point of the world on a light ground, inside the picture; size and offset as of OpenCV [px]."""
        self._labels.append((point, text, color, size, offset))

    def image(self) -> Image:
        """The picture with lines, hidden ones first and faint, and labels."""
        faint = self.picture.color.copy()
        self._draw(faint, seen=False)
        image = cv2.addWeighted(faint, _FAINT, self.picture.color, 1.0 - _FAINT, 0.0)
        self._draw(image, seen=True)
        for point, text, color, size, offset in self._labels:
            place, depth = project(self.picture.camera, point[None])
            if depth[0] <= _NEAR:
                continue
            (width, height), (rows, columns) = text_size(text, size), image.shape[:2]
            x = int(np.clip(place[0, 0] + offset[0], 2, columns - width - 4))
            y = int(np.clip(place[0, 1] + offset[1], height + 4, rows - 6))
            ground = image[y - height - 3 : y + 5, x - 2 : x + width + 3]
            ground[:] = (0.25 * ground + 0.75 * 255).astype(np.uint8)
            put_text(image, text, (x, y), size, color)
        return image

    def _draw(self, image: Image, *, seen: bool) -> None:
        """Draw the pieces that are seen, or those that are hidden."""
        for ends, visible, color, width in self._lines:
            if visible == seen:
                start, stop = (tuple(int(v) for v in np.rint(np.clip(place, -1e4, 1e4) * (1 << _SHIFT))) for place in ends)
                cv2.line(image, start, stop, color, width, cv2.LINE_AA, _SHIFT)

    def _seen(self, place: np.ndarray, depth: float) -> bool:
        """Visibility of a point at a pixel: whether no surface is in front of it."""
        column, row = int(place[0]), int(place[1])
        rows, columns = self.picture.depth.shape
        return not (0 <= row < rows and 0 <= column < columns) or depth <= float(self.picture.depth[row, column]) * (1.0 + _SLACK)


def draw_camera(canvas: Canvas, camera: Camera, label: str, color: Color, *, size: float, floor: float, most: float) -> None:
    """Draw a camera as a pyramid of depth `size`, with a triangle on its upper side, and its rays to a floor or a depth of `most` [m]."""
    at, along = camera.center, rays(camera, image_border(camera, 1))
    ends = at + size / max(1.0, np.linalg.norm(along, axis=1).max() / _WIDE) * along
    for end in ends:
        canvas.line(at, end, color, 2)
    canvas.path(ends, color, 2, closed=True)
    top, height = ends[:2], np.linalg.norm(ends[3] - ends[0])
    tip = top.mean(axis=0) - 0.35 * height * camera.rotation[1]
    canvas.path(np.stack([top[0], tip, top[1]]), color, 2)
    border, meets = footprint(camera, floor + _LIFT, most)
    for index in range(0, len(border), _EDGE):
        canvas.line(ends[index // _EDGE], border[index], color, 1)
    for start, stop, both in zip(border, np.roll(border, -1, axis=0), meets & np.roll(meets, -1), strict=True):
        if both:
            canvas.line(start, stop, color, 1)
    canvas.label(tip, label, color)


def draw_axes(canvas: Canvas, length: float) -> None:
    """Draw the axes of the world, x red, y green, z blue, with their length."""
    for axis, (name, color) in enumerate((("x", (40, 40, 210)), ("y", (40, 140, 40)), ("z", (210, 80, 30)))):
        tip = length * np.eye(3)[axis] + (0.0, 0.0, 2 * _LIFT)
        canvas.line(np.array((0.0, 0.0, 2 * _LIFT)), tip, color, 2, on_top=True)
        canvas.label(tip, f"{name} {length:g} m" if axis == 0 else name, color, 0.45, (4, 4))
