"""Small analytic scenes and their rendering: shapes under simple lights; views of many boxes, placed at random, without physics."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Effect
from synpick_warp.configs.schema import FAST, Bop, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, EnvironmentMap, Fixture, Material, Prop, TriangleMesh
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, ViewBuffers, allocate_view_buffers, view_buffer_sizes
from synpick_warp.stages.render.annotate import BoundaryBuffers, BoundaryScratch, boundary_sizes, list_boundaries
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import RenderScene, build_render_scene
from synpick_warp.stages.render.view_setup import first_views, make_views
from synpick_warp.testing.box_views import catalog
from synpick_warp.views.frames import FrameBatch
from tests.twins.masks import bits_of, masks_of_buffers
from tests.worlds.shapes import (
    FLAT,
    GREY,
    UPRIGHT,
    ball,
    box,
    entry,
    even_light,
    random_pile,
    sheet,
    surface,
)

ANNOTATIONS = ("depth", "instance", "amodal", "pixels", "boxes")
"""Fields of `RenderedViews` that the light does not change."""


def with_render(mode: str = FAST, **settings) -> Config:
    """Default settings with others of the renderer."""
    return Config(render=replace(Config().render, mode=mode, **settings))


@dataclass
class ToyScene:
    """A scene: poses are x, y, z [m] and a quaternion x, y, z, w; every camera renders every world."""

    entries: list[CatalogEntry]
    placed: list[list[tuple[int, tuple[float, ...]]]]
    """(entry, pose) of the instances of each world."""
    cameras: tuple[Camera, ...]
    lights: tuple[EnvironmentMap, ...] = (even_light(),)
    fixtures: tuple[Fixture, ...] = (Fixture(box(1, 1, 0.1), GREY),) + (Fixture(box(0.1, 0.1, 0.1), GREY),) * 2
    fixture_poses: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 0.0, *UPRIGHT),) * 3
    fixtures_visible: tuple[int, int, int] = (0, 0, 0)
    bin: int = 0
    """Bin of every world; more of them come first in `fixtures`."""
    instances: int = 4
    """Instance capacity of a world."""
    light_yaw: float = 0.0
    light_exposure: float = 0.0
    table: bool = False
    looks: Looks | None = None
    props: tuple[Prop, ...] = ()
    config: Config = field(default_factory=Config)

    def settings(self) -> Config:
        return replace(self.config, render=replace(self.config.render, table=self.table))


@dataclass(frozen=True)
class RenderedViews:
    """Arrays of a rendered batch, on the host: the first of `ViewBuffers`, the others of the renderer."""

    color: np.ndarray
    depth: np.ndarray
    instance: np.ndarray
    masks: np.ndarray
    """Amodal mask of each instance (B, I, H, W) bool."""
    pixels: np.ndarray
    boxes: np.ndarray
    exact_depth: np.ndarray
    """Planar depth of the G-buffer, before rounding (B, H, W) [m]."""
    radiance: np.ndarray
    resolve: np.ndarray
    """Anti-aliasing resolve codes, see `ShadedImage` (B, H, W) uint32."""

    @property
    def amodal(self) -> np.ndarray:
        """Bit i: the mask of instance i (B, H, W) uint32."""
        return bits_of(self.masks)


def assert_same(first: RenderedViews, second: RenderedViews, *names: str) -> None:
    """Compare fields of rendered views bit by bit."""
    for name in names:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio [dB]; the peak is the radiance of a white plane under a map of radiance 1."""
    return float(-10.0 * np.log10(np.mean((np.clip(a, 0.0, 1.0) - np.clip(b, 0.0, 1.0)) ** 2)))


def one(mesh: TriangleMesh, pose: tuple[float, ...], view: Camera, material: Material = GREY, **more) -> ToyScene:
    """A scene of one object and one camera."""
    return ToyScene([entry(mesh, material)], [[(0, pose)]], (view,), **more)


def several(meshes: Sequence[TriangleMesh], poses: Sequence[tuple[float, ...]], view: Camera, **more) -> ToyScene:
    """A scene of an object of each mesh and one camera."""
    return ToyScene([entry(mesh) for mesh in meshes], [list(enumerate(poses))], (view,), **more)


def clutter() -> list:
    """Boxes, balls and a plane of several materials, close together, for `render_objects`."""
    return [
        (sheet(0.6, 0.5), surface((0.8, 0.75, 0.7), 0.0, 0.7)),
        (box(0.08, 0.06, 0.1), surface((0.2, 0.5, 0.8), 0.0, 0.5), (0.06, 0.03, 0.05, *UPRIGHT)),
        (ball(0.045, 3), surface((0.9, 0.8, 0.5), 1.0, 0.4), (-0.05, 0.02, 0.045, *UPRIGHT)),
        (box(0.05, 0.12, 0.03), surface((0.8, 0.2, 0.2), 0.0, 0.9), (-0.02, -0.07, 0.015, 0.0, 0.0, np.sin(0.3), np.cos(0.3))),
    ]


def snapshot(toy: ToyScene, device: wp.Device) -> Snapshot:
    """Device snapshot of a scene; environment map 0 in every world."""
    worlds = len(toy.placed)
    entries = np.full((worlds, toy.instances), -1)
    poses = np.zeros((worlds, toy.instances, 7), np.float32)
    for world, placed in enumerate(toy.placed):
        for i, (which, pose) in enumerate(placed):
            entries[world, i] = which
            poses[world, i] = pose
    result = allocate(Snapshot, {"world": worlds, "instance": toy.instances, "fixture": 3}, device)
    result.catalog_index.assign(entries)
    result.pose.assign(poses)
    result.fixture_pose.assign(np.tile(np.array(toy.fixture_poses, np.float32), (worlds, 1, 1)))
    result.fixture_visible.assign(np.tile(np.array(toy.fixtures_visible), (worlds, 1)))
    result.bin.fill_(toy.bin)
    result.light_yaw.fill_(toy.light_yaw)
    result.light_exposure.fill_(toy.light_exposure)
    return result


def views_of(toy: ToyScene, device: wp.Device, cameras: Any = None) -> Any:
    """The struct `Views` of every world by every camera: view = world x cameras + camera; `cameras`: as of `make_views`."""
    places = np.indices((len(toy.placed), len(toy.cameras)), np.int32).reshape(2, -1)
    world, camera_index = (wp.array(values, dtype=wp.int32, device=device) for values in places)
    return make_views(world, camera_index, places.shape[1], toy.instances, cameras)


def build_scene(toy: ToyScene, device: wp.Device) -> RenderScene:
    """The renderer's constant data of a toy scene."""
    settings = toy.settings()
    catalog = Catalog(tuple(toy.entries), props=toy.props)
    return build_render_scene(settings.render, -settings.tote.wall, catalog, toy.fixtures, toy.cameras, toy.lights, device, toy.looks)


def render(toy: ToyScene, device: wp.Device, colors: bool = True) -> RenderedViews:
    """Render every world by every camera: view = world x cameras + camera. Without colours, `color`, `radiance` and `resolve` are empty."""
    scene, views = build_scene(toy, device), views_of(toy, device)
    renderer = make_renderer(toy.settings(), scene, toy.instances, views.count, colors=colors)
    out = allocate_view_buffers(views.count, scene.width, scene.height, toy.instances, device)
    renderer.render(snapshot(toy, device), views, out)
    images = {name: getattr(out, name).numpy() for name in ("color", "depth", "instance", "pixels", "boxes")}
    images["masks"] = masks_of_buffers(out)
    shown = {name: getattr(renderer.image, name).numpy() if colors else np.empty(0) for name in ("radiance", "resolve")}
    images |= {} if colors else {"color": np.empty(0)}
    return RenderedViews(**images, exact_depth=renderer.gbuffer.depth.numpy(), **shown)


def render_objects(device: wp.Device, *placed, view: Camera, config: Config | None = None, **more) -> RenderedViews:
    """Render objects (mesh, material, pose) in one view; without a pose they are at the origin."""
    entries = [entry(mesh, material) for mesh, material, *_ in placed] or [entry(sheet(0.1, 0.1))]
    world = [(index, pose[0] if pose else FLAT) for index, (_, _, *pose) in enumerate(placed)]
    return render(ToyScene(entries, [world], (view,), config=config or Config(), **more), device)


def render_gbuffer(toy: ToyScene, device: wp.Device) -> tuple[ViewBuffers, Renderer]:
    """Render the G-buffer of world 0 by camera 0 only."""
    toy = replace(toy, placed=toy.placed[:1], cameras=toy.cameras[:1])
    scene = build_scene(toy, device)
    renderer = make_renderer(toy.settings(), scene, toy.instances, 1, colors=False)
    out = allocate_view_buffers(1, scene.width, scene.height, toy.instances, device)
    renderer.render_gbuffer(snapshot(toy, device), views_of(toy, device), out)
    return out, renderer


def dense_toy(count: int, lenses: tuple[Camera, ...], room: int, seed: int = 0) -> ToyScene:
    """A world of `count` boxes of the catalog of `box_views`, in a heap that reaches beyond the images."""
    placed = random_pile(np.random.default_rng(seed), 2, count, (-0.4, -0.3, -0.2), (0.4, 0.3, 0.1))
    return ToyScene(list(catalog().entries), [placed], lenses, instances=room, config=Config(bop=Bop(depth_scale=0.1)))


def dense_batch(toy: ToyScene, device: wp.Device) -> FrameBatch:
    """The world's views by all cameras, as frame 0 of episode 0, with run boundaries."""
    scene, count = build_scene(toy, device), len(toy.cameras)
    renderer = make_renderer(toy.settings(), scene, toy.instances, count)
    out = allocate_view_buffers(count, scene.width, scene.height, toy.instances, device)
    world = snapshot(toy, device)
    renderer.render(world, first_views(count, count, toy.instances, device), out)
    sizes = boundary_sizes(view_buffer_sizes(count, scene.width, scene.height, toy.instances))
    scratch, boundaries = (allocate(kind, sizes, device) for kind in (BoundaryScratch, BoundaryBuffers))
    list_boundaries(scratch, count, out, boundaries)
    entries = world.catalog_index.numpy()[0]
    ids = np.append([entry.obj_id for entry in toy.entries], -1)[entries].astype(np.int32)
    images = {name: array.numpy() for name, array in (vars(out) | vars(boundaries)).items() if name not in ("effects", "bundle")}
    return FrameBatch(
        **images,
        episode=np.zeros(count, np.int32),
        camera=np.arange(count, dtype=np.int32),
        frame=np.zeros(count, np.int32),
        time=np.zeros(count),
        object_id=np.tile(ids, (count, 1)),
        pose=np.tile(world.pose.numpy()[0], (count, 1, 1)),
        effects=np.zeros((count, len(Effect)), np.float32),
        light_name=np.full(count, "even"),
        light_yaw=np.zeros(count, np.float32),
        light_exposure=np.zeros(count, np.float32),
        light_direction=np.zeros((count, 3), np.float32),
    )
