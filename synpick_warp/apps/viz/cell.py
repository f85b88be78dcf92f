"""Pictures of a cell before simulation: bins, gripper and objects on the floor, from outside with camera frusta, and from each camera."""

import colorsys
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import warp as wp

from synpick_warp.apps.viz.drawing import GOLDEN, INK, WHITE, Image, blank, check_picture_name, put_text, stacked, with_text, write_picture
from synpick_warp.apps.viz.frusta import Canvas, Picture, draw_axes, draw_camera, project, rays
from synpick_warp.configs.calibration.lens import with_matrix
from synpick_warp.configs.cell.bins import Bins, BinSizes
from synpick_warp.configs.cell.cameras import WORLD, Rig
from synpick_warp.configs.schema import FAST, Config
from synpick_warp.factory.assembly import compiling_if_cold, make_renderer
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import read_objects
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.props import make_props
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, RawObject
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import FIXTURES, Snapshot, allocate_view_buffers
from synpick_warp.stages.constants import GRIPPER_HOME
from synpick_warp.stages.render.scene import build_render_scene, with_cameras
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import Progress

OVER_RIM = 0.15
"""Height of the gripper's cup over the rim of the bin [m]."""
_SPACE = 0.01
"""Distance between objects, and from the walls [m]."""
_MOST = 32
"""Maximum number of objects: the instance capacity of a view."""
_SKY = "overcast"
_PIXELS = 640
"""Longest side of a camera's picture; larger images are scaled down [px]."""


@dataclass(frozen=True, eq=False)
class Laid:
    """Layout of objects side by side on the floor of a bin, in the orientation of their files."""

    indices: list[int]
    positions: list[tuple[float, float, float]]
    """Positions of their origins in the bin's frame [m]."""


class CellScene:
    """Scene of a cell before simulation: bins, gripper and objects, rendered from any camera."""

    def __init__(
        self, config: Config, progress: Progress, report: Callable[[str], None], objects: Sequence[RawObject] | None = None
    ) -> None:
        """Build the scene of objects; None: read them. Raises SynpickError if device, bins, cameras or all objects cannot be used."""
        self.config = replace(config, render=replace(config.render, mode=FAST, layers=(), random_yaw=False))
        self.device = device = pick_device(config.bake.device)
        self.sizes = config.cell.bins
        bins = make_bins(self.sizes)
        for line in (line for one in bins for line in one.notes):
            report(line)
        if objects is None:
            progress.stage("reading objects")
            objects = read_objects(config.bake.models, config.objects, config.object_rows, config.cell.bins, report)
        self.objects = objects
        self.laid = [lay_out(self.objects, sizes) for sizes in self.sizes]
        catalog = Catalog(tuple(map(_entry, self.objects)), props=make_props(config.prop, self.sizes, report))
        light = next(sky for sky in skies() if sky.name == _SKY)
        with compiling_if_cold(config, device, progress, online=True):
            fixtures = make_fixtures(bins, config.gripper)
            any_camera = Camera(1, 1, np.eye(3), np.eye(3), np.zeros(3))
            self.scene = build_render_scene(self.config.render, bins[0].sizes.ground, catalog, fixtures, (any_camera,), (light,), device)
        self.snapshot = self._snapshot()

    @property
    def tcp(self) -> tuple[float, float, float]:
        """Where the gripper is drawn: its cup over the highest rim [m]."""
        return (*self.sizes[0].origin[:2], self.sizes[0].ground + max(one.height - one.base for one in self.sizes) + OVER_RIM)

    def placed(self, camera: Camera) -> Camera:
        """Camera in the world; one on the gripper where that is drawn."""
        if camera.fixed_to == WORLD:
            return camera
        shaft = (*self.tcp[:2], self.tcp[2] + self.config.gripper.cup_length)
        return replace(camera, translation=camera.translation - camera.rotation @ shaft, fixed_to=WORLD)

    def _snapshot(self) -> Snapshot:
        """A world for each bin with the gripper over it, and a last one of the first bin without."""
        worlds = len(self.sizes) + 1
        place = np.zeros((worlds, len(FIXTURES), 7), np.float32)
        place[..., 6] = 1.0
        place[:, 1:, :3] = (*self.tcp[:2], self.tcp[2] + self.config.gripper.cup_length)
        entries, poses = np.full((worlds, _MOST), -1), np.zeros((worlds, _MOST, 7), np.float32)
        poses[..., 6] = 1.0
        which = [*range(len(self.sizes)), 0]
        for world, index in enumerate(which):
            sizes, laid = self.sizes[index], self.laid[index]
            lift = self.sizes[0].ground - sizes.ground
            turn = (0.0, 0.0, math.sin(sizes.turn / 2.0), math.cos(sizes.turn / 2.0))
            place[world, 0] = (*np.add(sizes.to_world((0.0, 0.0, 0.0)), (0.0, 0.0, lift)), *turn)
            for slot, (entry, position) in enumerate(zip(laid.indices, laid.positions, strict=True)):
                entries[world, slot] = entry
                poses[world, slot] = (*np.add(sizes.to_world(position), (0.0, 0.0, lift)), *turn)
        visible = np.ones((worlds, len(FIXTURES)), np.int32)
        visible[:, 0] = [self.sizes[index].is_visible for index in which]
        visible[-1, 1:] = 0
        result = allocate(Snapshot, {"world": worlds, "instance": _MOST, "fixture": len(FIXTURES)}, self.device)
        columns = {"catalog_index": entries, "pose": poses, "fixture_pose": place, "fixture_visible": visible, "bin": which}
        for name, values in columns.items():
            getattr(result, name).assign(np.array(values))
        return result

    def render(self, camera: Camera, world: int) -> Picture:
        """A view of a world: that of a bin's index, or -1, the first bin without the gripper."""
        scene = with_cameras(self.scene, (camera,))
        renderer = make_renderer(self.config, scene, _MOST, 1)
        out = allocate_view_buffers(1, scene.width, scene.height, _MOST, self.device)
        of_world = wp.full(1, world % (len(self.sizes) + 1), dtype=wp.int32, device=self.device)
        renderer.render(self.snapshot, make_views(of_world, wp.zeros(1, dtype=wp.int32, device=self.device), 1, _MOST), out)
        return Picture(camera, np.ascontiguousarray(out.color.numpy()[0][..., ::-1]), renderer.gbuffer.depth.numpy()[0])


def scaled_down(camera: Camera, most: int = _PIXELS) -> Camera:
    """The same camera with smaller images, whose longest side is `most` [px]; smaller ones stay as they are."""
    scale = most / max(camera.resolution)
    if scale >= 1.0:
        return camera
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    # Pixel centres are at + 0.5, so that coordinates scale about the corner of the image.
    matrix = np.diag((width / camera.width, height / camera.height, 1.0)) @ camera.matrix
    return replace(camera, width=width, height=height, matrix=matrix, lens=with_matrix(camera.lens, matrix, (width, height)))


def lay_out(objects: Sequence[RawObject], sizes: BinSizes) -> Laid:
    """Lay as many objects on a bin's floor as there is room for, row by row, in their order; of its compartments in the largest.

    On a slope, they touch the floor where that is highest below them. If the floor has room for none, the first that fits between the
    walls lies as high as these are wide enough.
    """
    laid = Laid([], [])
    (left, front, length, width, a, b, c), opening = max(
        zip(sizes.floors, sizes.openings, strict=True), key=lambda room: room[0][2] * room[0][3]
    )
    floor_sides, middle = np.array((length, width)), (left, front)
    left, front = left - length / 2, front - width / 2
    x, y, depth = _SPACE, _SPACE, 0.0
    for index, raw in enumerate(objects):
        low, high = raw.mesh.vertices.min(axis=0), raw.mesh.vertices.max(axis=0)
        size = high - low
        if x + size[0] > length - _SPACE:
            x, y, depth = _SPACE, y + depth + _SPACE, 0.0
        if x + size[0] > length - _SPACE or y + size[1] > width - _SPACE or len(laid.indices) == _MOST:
            continue
        laid.indices.append(index)
        floor = c + max(a * (left + x), a * (left + x + float(size[0]))) + max(b * (front + y), b * (front + y + float(size[1])))
        laid.positions.append((left + x - float(low[0]), front + y - float(low[1]), floor - float(low[2])))
        x, depth = x + float(size[0]) + _SPACE, max(depth, float(size[1]))
    for index, raw in enumerate(objects if not laid.indices else ()):
        low, high = raw.mesh.vertices.min(axis=0).astype(float), raw.mesh.vertices.max(axis=0).astype(float)
        spare = np.array(opening[2:]) - floor_sides
        share = float((((high - low)[:2] + 2.0 * _SPACE - floor_sides) / np.maximum(spare, 1e-9)).max())
        if share < 1.0:
            center = np.array((*middle, c)) + share * np.array((*np.subtract(opening[:2], middle), sizes.height - c))
            laid.indices.append(index)
            laid.positions.append((*(center[:2] - (low + high)[:2] / 2.0).tolist(), float(center[2] - low[2])))
            break
    return laid


def _entry(raw: RawObject) -> CatalogEntry:
    radius = float(np.linalg.norm(raw.mesh.vertices, axis=1).max())
    shape = {"pieces": (), "volume": raw.hull.volume, "radius": radius, "mass": 1.0, "center_of_mass": np.zeros(3), "inertia": np.eye(3)}
    known = {name: getattr(raw, name) for name in ("obj_id", "name", "mesh", "material", "symmetries_discrete", "symmetries_continuous")}
    return CatalogEntry(**known, **shape, diameter=raw.hull.diameter, source=raw.source)


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
    """Draw a cell with the cameras of its rig, and write the image file; returns its path. `bins` are the settings of what stands under
    them, `name` is for the title. Raises ConfigError if a camera's pose is degenerate, and OutputError if the file cannot be written."""
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


def _draw_outside(scene: CellScene, index: int, outside: Camera, cameras: tuple[Camera, ...], names: tuple[str, ...]) -> Image:
    """The cell with one of its bins, from outside."""
    canvas = Canvas(scene.render(outside, index))
    points = [corner for one in scene.sizes for corner in one.corners] + [tuple(camera.center) for camera in cameras]
    size = float(np.ptp(np.array(points), axis=0).max())
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
    height = max(image.shape[0] for image in images)
    padded = [cv2.copyMakeBorder(image, 0, height - image.shape[0], 0, _GAP, cv2.BORDER_CONSTANT, value=WHITE) for image in images]
    return np.concatenate(padded, axis=1)[:, :-_GAP]
