"""What tools.bench measures beside newton.sensors.SensorCamera: the same scene, views and outputs, by both renderers."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from scipy.spatial.transform import Rotation

from synpick_warp.arrays import allocate
from synpick_warp.codes import Segment
from synpick_warp.configs.schema import Config
from synpick_warp.pipeline import Factory
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.types import Camera, Catalog, Fixture, Material, TriangleMesh
from synpick_warp.stages.buffers import LayerBuffers, Snapshot
from synpick_warp.stages.render.layers import LayerRenderer
from synpick_warp.stages.render.view_setup import make_views
from tools.bench.physics import BURST, Row, seconds_per_call

ORDERS = {
    "as it comes": SensorCamera.RenderConfig(),
    "in tiles of 8 x 4": SensorCamera.RenderConfig(render_order=SensorCamera.RenderOrder.TILED, tile_width=8, tile_height=4),
}
"""Orders in which the sensor visits pixels; the faster one counts."""
LAYERS = ("normals", "albedo")
OPENGL = np.diag([1.0, -1.0, -1.0])
"""Axes of a camera that looks along -z, in those of one that looks along +z with y down."""
DEPTH_TOLERANCE = 1.0
"""Depths are the same within this many counts: ours is rounded to half a count, theirs is found in the world, in single precision."""
NORMAL_TOLERANCE = 1.0
"""Normals are the same within this angle [°]."""
CHECKED_VIEWS = 6
"""Views of a batch in which both are compared: two worlds."""


@dataclass(frozen=True, eq=False)
class SensorScene:
    """A Newton model of what the first views of a snapshot show, and what its sensor needs to render them."""

    model: newton.Model
    state: newton.State
    sensor: SensorCamera
    rays: Any
    """Of a pixel, in the camera (row, column, 1, 2) vec3."""
    transforms: Any
    """Camera to world, of each view (B) transform."""
    worlds: Any
    """Of each view (B) int32."""
    codes: np.ndarray
    """Of each shape, as in `FrameBatch.instance` (shape) int64; one more for pixels without a shape."""

    def outputs(self, **kinds: str) -> dict[str, Any]:
        """Images to render, by the name of the sensor's argument; the values are the ends of its allocators' names."""
        size = (len(self.worlds), self.rays.shape[1], self.rays.shape[0])
        return {name: getattr(self.sensor, f"allocate_image_{kind}")(*size) for name, kind in kinds.items()}

    def render(self, render_config: Any, images: dict[str, Any]) -> None:
        """Put bodies where the state has them, and render all views."""
        self.model.bvh_refit_shapes(self.state)
        self.sensor.update(self.state, self.transforms, self.rays, world_indices=self.worlds, render_config=render_config, **images)


def build_sensor_scene(
    config: Config,
    catalog: Catalog,
    fixtures: tuple[Fixture, ...],
    cameras: tuple[Camera, ...],
    table: float,
    snapshot: Snapshot,
    count: int,
    device: Any,
) -> SensorScene:
    """Build the worlds of the first `count` views, which go world by world and camera by camera.

    Args:
        config: All settings.
        catalog: Whose entries the snapshot names.
        fixtures: Tote, finger, cup.
        cameras: With one matrix among them, since the sensor has one bundle of rays for all views.
        table: Height of the table [m]; there is one if the settings say so.
        snapshot: The worlds.
        count: Views.
        device: Where both renderers work.
    """
    model, codes = _build_model(config, catalog, fixtures, table, snapshot, -(-count // len(cameras)), device)
    sensor = SensorCamera(model)
    sensor.create_default_light()
    width, height, matrix = cameras[0].width, cameras[0].height, cameras[0].matrix
    rays = SensorCamera.compute_camera_rays_pinhole_opencv(
        width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], device=device
    )
    view = np.arange(count)
    transforms = np.array([_camera_to_world(camera) for camera in cameras], np.float32)[view % len(cameras)]
    return SensorScene(
        model,
        model.state(),
        sensor,
        rays,
        wp.array(transforms, dtype=wp.transformf, device=device),
        wp.array(view // len(cameras), dtype=wp.int32, device=device),
        np.array([*codes, Segment.NOTHING]),
    )


def _build_model(
    config: Config, catalog: Catalog, fixtures: tuple[Fixture, ...], table: float, snapshot: Snapshot, worlds: int, device: Any
) -> tuple[newton.Model, list[int]]:
    """The model of the first worlds, and the code of each of its shapes."""
    objects = [_newton_mesh(entry.mesh, entry.material) for entry in catalog.entries]
    things = [_newton_mesh(fixture.mesh, fixture.material) for fixture in fixtures]
    builder = newton.ModelBuilder()
    # As ours: built once and with care, for speed of the rays.
    builder.default_bvh_cfg.mesh_constructor = builder.default_bvh_cfg.shape_constructor = "sah"
    shape = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)
    host = {name: getattr(snapshot, name).numpy() for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible")}
    codes = []
    for world in range(worlds):
        builder.begin_world()
        for instance, entry in enumerate(host["catalog_index"][world]):
            if entry >= 0:
                _add_body(builder, objects[entry], catalog.entries[entry].material, host["pose"][world, instance], shape)
                codes.append(1 + instance)
        for number, visible in enumerate(host["fixture_visible"][world]):
            if visible:
                _add_body(builder, things[number], fixtures[number].material, host["fixture_pose"][world, number], shape)
                codes.append(Segment.TOTE + number)
        if config.render.table:
            builder.add_shape_plane((0.0, 0.0, 1.0, -table), width=0.0, length=0.0, cfg=shape, color=config.render.table_color)
            codes.append(Segment.TABLE)
        builder.end_world()
    return builder.finalize(device=device), codes


class _Mesh(newton.Mesh):
    """A mesh with a texture of its own: Newton tells textures apart by a thousand of their bytes, which may all lie on a black border."""

    @property
    def texture_hash(self) -> int:
        return id(self.texture)


def _newton_mesh(mesh: TriangleMesh, material: Material) -> newton.Mesh:
    uvs = None if material.texture is None else mesh.uv
    return _Mesh(mesh.vertices, mesh.faces.reshape(-1), normals=mesh.normals, uvs=uvs, texture=material.texture, compute_inertia=False)


def _add_body(builder: newton.ModelBuilder, mesh: newton.Mesh, material: Material, pose: np.ndarray, shape: Any) -> None:
    """A body of its own, as things that move have; its mass does not show."""
    body = builder.add_body(xform=wp.transform(*pose.tolist()), mass=1.0, inertia=wp.mat33(np.eye(3)))
    builder.add_shape_mesh(body, mesh=mesh, cfg=shape, color=material.color)


def _camera_to_world(camera: Camera) -> np.ndarray:
    """x, y, z [m] and quaternion x, y, z, w (7) of a camera that looks along -z."""
    turn = camera.rotation.T
    return np.concatenate([-turn @ camera.translation, Rotation.from_matrix(turn @ OPENGL).as_quat()])


def agreement(scene: SensorScene, index: np.ndarray, depth: np.ndarray, code: np.ndarray, counts: np.ndarray, scale: float) -> list[Row]:
    """How far two renderers agree about what the same pixels show, and how far away it is.

    Args:
        scene: The sensor's scene.
        index: Its shapes (B, H, W) uint32; the largest number where there is none.
        depth: Its planar depth (B, H, W) float32 [m].
        code: Our instances (B, H, W) uint8.
        counts: Our planar depth (B, H, W) uint16, in counts of `scale` mm.
        scale: Millimetres of a count.
    """
    same = scene.codes[np.minimum(index, len(scene.codes) - 1)] == code
    apart = np.abs(depth * (1000.0 / scale) - counts)
    close = same & (apart <= DEPTH_TOLERANCE)
    most = float(apart[same].max()) * scale if same.any() else 0.0
    return [
        Row("sensor", "pixels in which both see the same thing", 100.0 * float(same.mean()), "%"),
        Row("sensor", f"the same, at the same depth within {DEPTH_TOLERANCE * scale:g} mm", 100.0 * float(close.mean()), "%"),
        Row("sensor", "largest difference of depths of the same thing", most, "mm"),
    ]


def surface_agreement(cameras: tuple[Camera, ...], normal: np.ndarray, albedo: np.ndarray, layers: dict[str, np.ndarray]) -> list[Row]:
    """How far two renderers agree about the surfaces that the same pixels show; view v is of camera v mod cameras.

    Args:
        cameras: The cameras.
        normal: The sensor's normals, in the world (B, H, W, 3) float32.
        albedo: Its base colour (B, H, W) uint32, red in the lowest byte.
        layers: Our normals, in the camera and towards it (B, H, W, 3) float32, and base colour (B, H, W, 3) uint8.
    """
    turns = np.array([cameras[view % len(cameras)].rotation for view in range(len(normal))])
    turned = np.einsum("bij,bhwj->bhwi", turns, normal)
    cosine = np.abs((turned * layers["normals"]).sum(axis=-1))[layers["normals"].any(axis=-1)]
    color = np.stack([albedo >> shift & 255 for shift in (0, 8, 16)], axis=-1)
    apart = np.abs(color.astype(np.int16) - layers["albedo"])
    straight = 100.0 * float((cosine >= np.cos(np.radians(NORMAL_TOLERANCE))).mean()) if cosine.size else 100.0
    return [
        Row("sensor", f"surfaces with the same normal within {NORMAL_TOLERANCE:g}°", straight, "%"),
        Row("sensor", "mean difference of base colours, theirs not minified", float(apart.mean()), "grey"),
    ]


def measure_sensor(config: Config, factory: Factory, least: float) -> Iterator[Row]:
    """Time of a view by both renderers, for three sets of outputs.

    Both place bodies and render a batch of views; on CUDA both only launch, so that the host's time hides behind the device's. The
    sensor has no light maps, no amodal bits, no counts and boxes, and no minified textures.
    """
    simulation, renderer = factory.simulation, factory.stream.renderer
    device, snapshot = simulation.device, simulation.records[0].snapshot
    count = min(factory.stream.batch, simulation.layout.worlds * len(factory.cameras))
    started = time.perf_counter()
    fixtures = make_fixtures(config.tote, config.gripper)
    table = float(renderer.scene.table.height)
    scene = build_sensor_scene(config, factory.catalog, fixtures, factory.cameras, table, snapshot, count, device)
    wp.synchronize_device(device)
    yield Row("sensor", "build a Newton model of the batch's worlds", time.perf_counter() - started, "s")
    yield Row("sensor", "views in a batch", count, "")
    ours = _Ours(config, factory, count)
    seen = scene.outputs(forward_depth_image="depth_forward", shape_index_image="shape_index")
    named = scene.outputs(normal_image="normal", albedo_image="albedo")
    colored = scene.outputs(color_image="color")

    def pace(function: Callable[[], object]) -> float:
        return seconds_per_call(function, device, least / 4, BURST) / count

    times = [pace(ours.hits)]
    orders = {name: pace(functools.partial(scene.render, order, seen)) for name, order in ORDERS.items()}
    best = min(orders, key=orders.__getitem__)
    checked = min(count, CHECKED_VIEWS)
    arrays = (seen["shape_index_image"], seen["forward_depth_image"], ours.out.instance, ours.out.depth)
    index, depth, code, counts = (array[:checked].numpy() for array in arrays)
    yield from agreement(scene, index, depth, code, counts, config.bop.depth_scale)
    for name, seconds in orders.items():
        yield Row("sensor", f"SensorCamera, pixels {name}: depth, index", 1e3 * seconds, "ms")
        yield Row("sensor", f"the same over ours, pixels {name}", seconds / times[0], "")
    yield from _pair("depth, index", ", amodal bits", "", times[0], orders[best])
    textured = replace(ORDERS[best], enable_textures=True)
    times = [pace(ours.hits_and_layers), pace(functools.partial(scene.render, textured, seen | named))]
    layers = {name: getattr(ours.layers, name)[:checked].numpy() for name in LAYERS}
    normal, albedo = (image[:checked].numpy() for image in named.values())
    yield from surface_agreement(factory.cameras, normal, albedo, layers)
    yield from _pair("depth, index, normals, albedo", ", amodal bits", "", *times)
    lit = replace(textured, enable_shadows=True)
    times = [pace(ours.picture), pace(functools.partial(scene.render, lit, seen | colored))]
    yield from _pair("colour, depth, index", ", amodal bits, counts, boxes", ", by one light", *times)


class _Ours:
    """What our renderer does with the first views of the last snapshot."""

    def __init__(self, config: Config, factory: Factory, count: int) -> None:
        self.renderer, self.out = factory.stream.renderer, factory.stream.buffers[0]
        self.snapshot = factory.simulation.records[0].snapshot
        scene, cameras, view = self.renderer.scene, len(factory.cameras), np.arange(count, dtype=np.int32)
        world, camera = (wp.array(v, dtype=wp.int32, device=scene.device) for v in (view // cameras, view % cameras))
        self.views = make_views(world, camera, count, self.renderer.instances)
        self.layer_renderer = LayerRenderer(LAYERS, None, scene, self.renderer.instances, count)
        self.layers = allocate(LayerBuffers, {"view": count, "row": scene.height, "column": scene.width}, scene.device, LAYERS)

    def hits(self) -> None:
        self.renderer.render_gbuffer(self.snapshot, self.views, self.out)

    def hits_and_layers(self) -> None:
        self.hits()
        self.layer_renderer.render(self.snapshot, self.renderer.bodies, self.renderer.gbuffer, self.views, self.layers)

    def picture(self) -> None:
        self.renderer.render(self.snapshot, self.views, self.out)


def _pair(outputs: str, ours_too: str, theirs_too: str, ours: float, theirs: float) -> Iterator[Row]:
    """Times of a view [s] by both, and their ratio."""
    yield Row("sensor", f"ours: {outputs}{ours_too}", 1e3 * ours, "ms")
    yield Row("sensor", f"SensorCamera: {outputs}{theirs_too}", 1e3 * theirs, "ms")
    yield Row("sensor", f"SensorCamera's time over ours: {outputs}", theirs / ours, "")
