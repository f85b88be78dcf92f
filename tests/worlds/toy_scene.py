"""Small analytic scenes and their rendering: boxes, spheres and rectangles under simple lights."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
import warp as wp

from synpick_warp.configs.calibration.lens import PINHOLE, Lens, LensMap
from synpick_warp.configs.schema import FAST, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, EnvironmentMap, Fixture, Material, TriangleMesh
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, ViewBuffers, allocate_view_buffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import RenderScene, build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tests.twins.masks import bits_of, masks_of_buffers

GREY = Material(color=(0.7, 0.7, 0.7), texture=None, metallic=0.0, roughness=0.8)
DOWN = np.diag([1.0, -1.0, -1.0])
"""World to camera of a camera that looks down; up in the image is +y."""
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
FLAT = (0.0, 0.0, 0.0, *UPRIGHT)
"""Pose at the origin."""
WHITE = (1.0, 1.0, 1.0)


def flat_shaded(vertices: np.ndarray, faces: np.ndarray) -> TriangleMesh:
    """A mesh with three vertices a triangle, face normals and zero texture coordinates."""
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = 3 * len(faces)
    return TriangleMesh(
        vertices=corners.reshape(count, 3).astype(np.float32),
        faces=np.arange(count, dtype=np.int32).reshape(-1, 3),
        normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        uv=np.zeros((count, 2), np.float32),
    )


def box(x: float, y: float, z: float) -> TriangleMesh:
    """A box centred at its origin [m]."""
    mesh = trimesh.creation.box(extents=(x, y, z))
    return flat_shaded(mesh.vertices, mesh.faces)


def ball(radius: float, subdivisions: int) -> TriangleMesh:
    """A smooth-shaded icosphere with its vertices on the sphere [m]."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices = np.asarray(mesh.vertices)
    return TriangleMesh(
        vertices=vertices.astype(np.float32),
        faces=np.asarray(mesh.faces, dtype=np.int32),
        normals=(vertices / radius).astype(np.float32),
        uv=np.zeros((len(vertices), 2), np.float32),
    )


def sheet(width: float, height: float) -> TriangleMesh:
    """A rectangle that faces up, u along +x and v along +y."""
    x, y = width / 2.0, height / 2.0
    return TriangleMesh(
        vertices=np.array([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], np.float32),
        faces=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        uv=np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32),
    )


def surface(color=WHITE, metallic: float = 0.0, roughness: float = 1.0, texture: np.ndarray | None = None) -> Material:
    """A material, matt by default."""
    return Material(color=color, texture=texture, metallic=metallic, roughness=roughness)


def entry(mesh: TriangleMesh, material: Material = GREY) -> CatalogEntry:
    """A catalog entry for rendering; its physical properties are arbitrary."""
    return CatalogEntry(
        obj_id=1,
        name="toy",
        mesh=mesh,
        material=material,
        pieces=(),
        volume=1e-3,
        radius=float(np.linalg.norm(mesh.vertices, axis=1).max()),
        mass=1.0,
        center_of_mass=np.zeros(3),
        inertia=np.eye(3),
        diameter=1.0,
        symmetries_discrete=(),
        symmetries_continuous=(),
        source=None,
    )


def camera(width: int, height: int, focal: float, center: tuple[float, float, float], rotation: np.ndarray = DOWN) -> Camera:
    """A camera at `center` [m] with its principal point in the middle of the image."""
    matrix = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
    return Camera(width, height, matrix, rotation, -rotation @ np.asarray(center, dtype=np.float64))


def distorted(view: Camera, *coefficients: float, model: str = PINHOLE) -> Camera:
    """The same camera behind a lens."""
    k = view.matrix
    lens = LensMap(Lens(model, coefficients), (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), (view.width, view.height))
    return replace(view, lens=lens)


def even_light(radiance: float = 1.0, rows: int = 16) -> EnvironmentMap:
    """Constant white environment."""
    return EnvironmentMap("even", np.full((rows, 2 * rows, 3), radiance, np.float32))


def lamp(cosine: float, radius: float, radiance: float, sky: float = 0.0, rows: int = 256) -> EnvironmentMap:
    """A uniform sky with a disc lamp of angular radius `radius` [rad] at azimuth 0, its edge one texel soft."""
    directions, _ = map_directions(rows)
    angle = np.arccos(np.clip(directions @ np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine], np.float32), -1.0, 1.0))
    coverage = np.clip((radius - angle) / (np.pi / rows) + 0.5, 0.0, 1.0)
    return EnvironmentMap("lamp", np.repeat(sky + radiance * coverage[..., None], 3, axis=2).astype(np.float32))


def sun(direction: tuple[float, float, float], sky: float = 0.3, strength: float = 2000.0, rows: int = 128) -> EnvironmentMap:
    """Constant sky with one bright texel."""
    x, y, z = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    radiance = np.full((rows, 2 * rows, 3), sky, np.float32)
    column = int((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * 2 * rows) % (2 * rows)
    radiance[min(int(np.arccos(z) / np.pi * rows), rows - 1), column] = strength
    return EnvironmentMap("sun", radiance)


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


def build_scene(toy: ToyScene, device: wp.Device) -> RenderScene:
    """The renderer's constant data of a toy scene."""
    settings = toy.settings()
    catalog = Catalog(tuple(toy.entries))
    return build_render_scene(settings.render, -settings.tote.wall, catalog, toy.fixtures, toy.cameras, toy.lights, device, toy.looks)


def render(toy: ToyScene, device: wp.Device, colors: bool = True) -> RenderedViews:
    """Render every world by every camera: view = world x cameras + camera. Without colours, `color`, `radiance` and `resolve` are empty."""
    config = toy.settings()
    scene = build_scene(toy, device)
    worlds, cameras = len(toy.placed), len(toy.cameras)
    views = worlds * cameras
    renderer = make_renderer(config, scene, toy.instances, views, colors=colors)
    out = allocate_view_buffers(views, scene.width, scene.height, toy.instances, device)
    view_world = wp.array(np.repeat(np.arange(worlds), cameras), dtype=wp.int32, device=device)
    view_camera = wp.array(np.tile(np.arange(cameras), worlds), dtype=wp.int32, device=device)
    renderer.render(snapshot(toy, device), make_views(view_world, view_camera, views, toy.instances), out)
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
    scene = build_scene(toy, device)
    renderer = make_renderer(toy.settings(), scene, toy.instances, 1, colors=False)
    out = allocate_view_buffers(1, scene.width, scene.height, toy.instances, device)
    zero = wp.zeros(1, dtype=wp.int32, device=device)
    views = make_views(zero, zero, 1, toy.instances)
    renderer.render_gbuffer(snapshot(toy, device), views, out)
    return out, renderer
