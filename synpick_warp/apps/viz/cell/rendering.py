"""Rendering of a cell from any camera: bins, table, gripper, and objects laid on the floor of the bin; nothing is simulated."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import warp as wp

from synpick_warp.configs.calibration.lens import with_matrix
from synpick_warp.configs.cell.cameras import WORLD
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.schema import FAST, Config
from synpick_warp.factory.assembly import build_smallest, compiling_if_cold, make_renderer
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.catalog import read_objects
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, RawObject
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import FIXTURES, Snapshot, allocate_view_buffers
from synpick_warp.stages.render.scene import build_render_scene, with_cameras
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import Progress, SilentProgress

OVER_RIM = 0.15
"""Height of the gripper's cup over the rim of the bin [m]."""
_GAP = 0.01
"""Distance between objects, and from the walls [m]."""
_MOST = 32
"""Maximum number of objects: the instance capacity of a view."""
_SKY = "overcast"
_PIXELS = 640
"""Longest side of a camera's picture; larger images are scaled down [px]."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered view."""

    camera: Camera
    color: np.ndarray
    """(H, W, 3) uint8, blue first."""
    depth: np.ndarray
    """Planar depth (H, W) float32 [m]; 1e30: nothing is hit."""


@dataclass(frozen=True, eq=False)
class Laid:
    """Layout of objects side by side on the floor of a bin, in the orientation of their files."""

    indices: list[int]
    """Indices of the objects that are placed."""
    positions: list[tuple[float, float, float]]
    """Positions of their origins in the bin's frame [m]."""


class CellScene:
    """Scene of a cell before simulation: bins, gripper and objects, rendered from any camera."""

    def __init__(
        self, config: Config, progress: Progress, report: Callable[[str], None], objects: Sequence[RawObject] | None = None
    ) -> None:
        """Build the scene of some objects; None: they are read.

        Raises:
            SynpickError: Device, bins, cameras or all objects cannot be used.
        """
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
        catalog = Catalog(tuple(map(_entry, self.objects)))
        light = next(sky for sky in skies() if sky.name == _SKY)
        smallest = partial(build_smallest, config, device, SilentProgress(), False, True)
        with compiling_if_cold(smallest, device, progress):
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
        for name, values in {
            "catalog_index": entries,
            "pose": poses,
            "fixture_pose": place,
            "fixture_visible": visible,
            "bin": which,
        }.items():
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
    x, y, depth = _GAP, _GAP, 0.0
    for index, raw in enumerate(objects):
        low, high = raw.mesh.vertices.min(axis=0), raw.mesh.vertices.max(axis=0)
        size = high - low
        if x + size[0] > length - _GAP:
            x, y, depth = _GAP, y + depth + _GAP, 0.0
        if x + size[0] > length - _GAP or y + size[1] > width - _GAP or len(laid.indices) == _MOST:
            continue
        laid.indices.append(index)
        floor = c + max(a * (left + x), a * (left + x + float(size[0]))) + max(b * (front + y), b * (front + y + float(size[1])))
        laid.positions.append((left + x - float(low[0]), front + y - float(low[1]), floor - float(low[2])))
        x, depth = x + float(size[0]) + _GAP, max(depth, float(size[1]))
    for index, raw in enumerate(objects if not laid.indices else ()):
        low, high = raw.mesh.vertices.min(axis=0).astype(float), raw.mesh.vertices.max(axis=0).astype(float)
        spare = np.array(opening[2:]) - floor_sides
        share = float((((high - low)[:2] + 2.0 * _GAP - floor_sides) / np.maximum(spare, 1e-9)).max())
        if share < 1.0:
            center = np.array((*middle, c)) + share * np.array((*np.subtract(opening[:2], middle), sizes.height - c))
            laid.indices.append(index)
            laid.positions.append((*(center[:2] - (low + high)[:2] / 2.0).tolist(), float(center[2] - low[2])))
            break
    return laid


def _entry(raw: RawObject) -> CatalogEntry:
    """Entry of an object that is rendered and not simulated."""
    radius = float(np.linalg.norm(raw.mesh.vertices, axis=1).max())
    shape = {"pieces": (), "volume": raw.hull.volume, "radius": radius, "mass": 1.0, "center_of_mass": np.zeros(3), "inertia": np.eye(3)}
    known = {name: getattr(raw, name) for name in ("obj_id", "name", "mesh", "material", "symmetries_discrete", "symmetries_continuous")}
    return CatalogEntry(**known, **shape, diameter=raw.hull.diameter, source=raw.source)
