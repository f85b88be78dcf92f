"""Part `sensor`: newton.sensors.SensorCamera beside our renderer, time and agreement for the same scene, views and outputs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import Render
from synpick_warp.factory.assembly import build_factory
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.types import Camera, Catalog, Fixture, Material, TriangleMesh
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, allocate_view_buffers
from synpick_warp.stages.render.layers import LayerRenderer
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.system.progress import SilentProgress
from tools.bench import worlds
from tools.bench.run import FOREVER, Bench
from tools.options import Row

ORDERS = {
    "in default order": SensorCamera.RenderConfig(),
    "in tiles of 8 x 4": SensorCamera.RenderConfig(render_order=SensorCamera.RenderOrder.TILED, tile_width=8, tile_height=4),
}
"""Pixel orders of the sensor; the faster one is compared."""
LAYERS = ("normals", "albedo")
"""Layers that both renderers have."""
OPENGL = np.diag([1.0, -1.0, -1.0])
"""Rotation from OpenGL camera axes (looking along -z, y up) to OpenCV camera axes (looking along +z, y down)."""
DEPTH_TOLERANCE = 1.0
"""Tolerance of depths [counts]: ours is rounded to half a count, the sensor's is computed in world space in single precision."""
NORMAL_TOLERANCE = 1.0
"""Tolerance of normals [°]."""
MAX_WORLDS, CHECKED_VIEWS = 64, 6
"""Worlds that are settled, at most, and views in which the outputs are compared: two worlds."""


@dataclass(frozen=True, eq=False)
class SensorScene:
    """Newton model of the worlds of a snapshot's first views, and the inputs with which the sensor renders them."""

    model: newton.Model
    state: newton.State
    sensor: SensorCamera
    rays: Any
    """Origin and direction of each pixel's ray in the camera frame (row, column, 1, 2) vec3."""
    transforms: Any
    """Camera to world (view) transform."""
    worlds: Any
    """World of each view (view) int32."""
    segment: np.ndarray
    """Segmentation id of each shape (shape + 1) int64; the last one is of pixels without a shape."""

    def allocate_outputs(self, **allocators: str) -> dict[str, Any]:
        """Allocate images for `render`: sensor argument -> suffix of the sensor's `allocate_image_...` method."""
        size = (len(self.worlds), self.rays.shape[1], self.rays.shape[0])
        return {name: getattr(self.sensor, f"allocate_image_{suffix}")(*size) for name, suffix in allocators.items()}

    def render(self, render_config: Any, images: dict[str, Any]) -> None:
        """Update the BVH from the state and render all views."""
        self.model.bvh_refit_shapes(self.state)
        self.sensor.update(self.state, self.transforms, self.rays, world_indices=self.worlds, render_config=render_config, **images)


def build_sensor_scene(
    render: Render,
    catalog: Catalog,
    fixtures: tuple[Fixture, ...],
    cameras: tuple[Camera, ...],
    table: float,
    snapshot: Snapshot,
    count: int,
    device: Any,
) -> SensorScene:
    """Build the worlds of the first `count` views, which are ordered by world, then by camera.

    Args:
        render: Settings of the renderer.
        catalog: Objects that the snapshot's catalog indices refer to.
        fixtures: Tote, gripper shaft, cup.
        cameras: Cameras with equal intrinsics, since the sensor uses the same rays for all views.
        table: Height of the table [m], which is built if `render.table` is set.
        snapshot: Poses of the worlds.
        count: Count of views.
        device: Device of both renderers.
    """
    model, segment = _build_model(render, catalog, fixtures, table, snapshot, -(-count // len(cameras)), device)
    sensor = SensorCamera(model)
    sensor.create_default_light()
    width, height, matrix = cameras[0].width, cameras[0].height, cameras[0].matrix
    intrinsics = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    rays = SensorCamera.compute_camera_rays_pinhole_opencv(width, height, *intrinsics, device=device)
    view = np.arange(count)
    transforms = np.array([_camera_to_world(camera) for camera in cameras], np.float32)[view % len(cameras)]
    return SensorScene(
        model,
        model.state(),
        sensor,
        rays,
        wp.array(transforms, dtype=wp.transformf, device=device),
        wp.array(view // len(cameras), dtype=wp.int32, device=device),
        np.array([*segment, Segment.NOTHING]),
    )


def _camera_to_world(camera: Camera) -> np.ndarray:
    """Pose x, y, z [m], quaternion x, y, z, w (7) of the camera in OpenGL axes."""
    rotation = camera.rotation.T
    return np.concatenate([-rotation @ camera.translation, Rotation.from_matrix(rotation @ OPENGL).as_quat()])


def _build_model(
    render: Render, catalog: Catalog, fixtures: tuple[Fixture, ...], table: float, snapshot: Snapshot, count: int, device: Any
) -> tuple[newton.Model, list[int]]:
    """Build the Newton model of the first `count` worlds; returns it with the segmentation id of each shape."""
    objects = [(newton_mesh(entry.mesh, entry.material), entry.material) for entry in catalog.entries]
    others = [(newton_mesh(fixture.mesh, fixture.material), fixture.material) for fixture in fixtures]
    builder = newton.ModelBuilder()
    # SAH builds, as for our meshes: slower to build, faster to trace.
    builder.default_bvh_cfg.mesh_constructor = builder.default_bvh_cfg.shape_constructor = "sah"
    shape = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)
    host = {name: getattr(snapshot, name).numpy() for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible")}
    segment: list[int] = []
    for world in range(count):
        present = np.flatnonzero(host["catalog_index"][world] >= 0)
        visible = np.flatnonzero(host["fixture_visible"][world])
        bodies = [(objects[host["catalog_index"][world, index]], host["pose"][world, index], 1 + index) for index in present]
        bodies += [(others[index], host["fixture_pose"][world, index], Segment.TOTE + index) for index in visible]
        builder.begin_world()
        for (mesh, material), pose, number in bodies:
            # A movable body with one shape; its mass does not affect rendering.
            body = builder.add_body(xform=wp.transform(*pose.tolist()), mass=1.0, inertia=wp.mat33(np.eye(3)))
            builder.add_shape_mesh(body, mesh=mesh, cfg=shape, color=material.color)
            segment.append(int(number))
        if render.table:
            builder.add_shape_plane((0.0, 0.0, 1.0, -table), width=0.0, length=0.0, cfg=shape, color=render.table_color)
            segment.append(Segment.TABLE)
        builder.end_world()
    return builder.finalize(device=device), segment


class _Mesh(newton.Mesh):
    """Mesh whose texture is identified by object: Newton hashes a thousand of its bytes, which may all lie on a black border."""

    @property
    def texture_hash(self) -> int:
        return id(self.texture)


def newton_mesh(mesh: TriangleMesh, material: Material) -> newton.Mesh:
    """Convert a mesh; texture coordinates are left out without a texture."""
    uvs = None if material.texture is None else mesh.uv
    return _Mesh(mesh.vertices, mesh.faces.reshape(-1), normals=mesh.normals, uvs=uvs, texture=material.texture, compute_inertia=False)


def compare_hits(ids: np.ndarray, index: np.ndarray, depth: np.ndarray, segment: np.ndarray, counts: np.ndarray, scale: float) -> list[Row]:
    """Agreement of another renderer with ours in segmentation and depth.

    Args:
        ids: Segmentation id of each of its shapes (shape + 1) int64; the last one is of pixels without a shape.
        index: Its shape indices (view, row, column) uint32; the maximum value without a hit.
        depth: Its planar depth (view, row, column) float32 [m].
        segment: Our segmentation ids (view, row, column) uint8.
        counts: Our planar depth (view, row, column) uint16 [counts of `scale`].
        scale: Depth of one count [mm].
    """
    same = ids[np.minimum(index, len(ids) - 1)] == segment
    difference = np.abs(depth * (1000.0 / scale) - counts)
    close = same & (difference <= DEPTH_TOLERANCE)
    largest = float(difference[same].max()) * scale if same.any() else 0.0
    return [
        Row("pixels with the same instance in both", 100.0 * float(same.mean()), "%"),
        Row(f"pixels with the same instance and depth within {DEPTH_TOLERANCE * scale:g} mm", 100.0 * float(close.mean()), "%"),
        Row("largest difference of depths of the same instance", largest, "mm"),
    ]


def compare_surfaces(cameras: tuple[Camera, ...], normal: np.ndarray, albedo: np.ndarray, layers: dict[str, np.ndarray]) -> list[Row]:
    """Agreement of both renderers in normals and base colors; view v is of camera v % len(cameras).

    Args:
        cameras: The cameras.
        normal: The sensor's normals in world space (view, row, column, 3) float32.
        albedo: The sensor's base color (view, row, column) uint32, red in the lowest byte.
        layers: Our normals in camera space, facing the camera (view, row, column, 3) float32, and base color (view, row, column, 3) uint8.
    """
    rotations = np.array([cameras[view % len(cameras)].rotation for view in range(len(normal))])
    rotated = np.einsum("bij,bhwj->bhwi", rotations, normal)
    cosine = np.abs((rotated * layers["normals"]).sum(axis=-1))[layers["normals"].any(axis=-1)]
    color = np.stack([albedo >> shift & 255 for shift in (0, 8, 16)], axis=-1)
    difference = np.abs(color.astype(np.int16) - layers["albedo"])
    same_normal = 100.0 * float((cosine >= np.cos(np.radians(NORMAL_TOLERANCE))).mean()) if cosine.size else 100.0
    return [
        Row(f"surfaces with the same normal within {NORMAL_TOLERANCE:g}°", same_normal, "%"),
        Row("mean difference of base colors, the sensor's without texture minification", float(difference.mean()), "grey"),
    ]


def measure_sensor(bench: Bench) -> Iterator[Row]:
    """Benchmark of both renderers for three sets of outputs, on piles at rest.

    Both update poses and render a batch of views. On CUDA both launch without waiting, so that launch overhead is hidden. The
    sensor has no light maps, amodal masks, counts, boxes, or texture minification.
    """
    config = bench.config.with_values({"bake.worlds": min(bench.config.bake.worlds, MAX_WORLDS)})
    factory = build_factory(config, SilentProgress())
    simulation, renderer, cameras = factory.simulation, factory.stream.rings[0].renderer, factory.cameras
    simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
    for _ in range(worlds.FALL_TICKS + worlds.SETTLE_TICKS):
        simulation.tick()
    device, snapshot, scale = simulation.device, simulation.record.snapshot, config.bop.depth_scale
    count = min(factory.stream.rings[0].batch, simulation.layout.worlds * len(cameras))
    started = time.perf_counter()
    fixtures = make_fixtures(make_bins(config.cell.bins), config.gripper)
    table = float(renderer.scene.table.height)
    scene = build_sensor_scene(config.render, factory.catalog, fixtures, cameras, table, snapshot, count, device)
    wp.synchronize_device(device)
    yield Row("build a Newton model of the batch's worlds", time.perf_counter() - started, "s")
    yield Row("views in a batch", count, "")
    height, width, checked = renderer.scene.height, renderer.scene.width, slice(min(count, CHECKED_VIEWS))
    out, views = (
        allocate_view_buffers(count, width, height, renderer.instances, device),
        first_views(count, len(cameras), renderer.instances, device),
    )
    layer_renderer = LayerRenderer(LAYERS, None, renderer.scene, renderer.instances, count)
    our_layers = allocate(LayerBuffers, {"view": count, "row": height, "column": width}, device, LAYERS)
    hits = scene.allocate_outputs(forward_depth_image="depth_forward", shape_index_image="shape_index")
    surfaces = scene.allocate_outputs(normal_image="normal", albedo_image="albedo")
    gbuffer = partial(renderer.render_gbuffer, snapshot, views, out)

    def time_view(function: Callable[[], object]) -> float:
        """Time of one view [s]."""
        return bench.seconds_per_call(function, 0.25) / count

    def render_layers() -> None:
        """Layers, besides depth, ids and amodal masks."""
        gbuffer()
        layer_renderer.render(snapshot, renderer.bodies, renderer.gbuffer, views, our_layers, renderer.cameras)

    own = time_view(gbuffer)
    orders = {name: time_view(partial(scene.render, order, hits)) for name, order in ORDERS.items()}
    best = min(orders, key=orders.__getitem__)
    arrays = (hits["shape_index_image"], hits["forward_depth_image"], out.instance, out.depth)
    yield from compare_hits(scene.segment, *(array[checked].numpy() for array in arrays), scale)
    for name, seconds in orders.items():
        yield Row(f"SensorCamera, pixels {name}: depth, index", 1e3 * seconds, "ms")
        yield Row(f"SensorCamera's time over ours: depth, index, pixels {name}", seconds / own, "")
    yield from _comparison_rows("depth, index", ", amodal masks", "", (own, orders[best]), width * height)
    textured = replace(ORDERS[best], enable_textures=True)
    times = time_view(render_layers), time_view(partial(scene.render, textured, hits | surfaces))
    layers = {name: getattr(our_layers, name)[checked].numpy() for name in LAYERS}
    yield from compare_surfaces(cameras, *(image[checked].numpy() for image in surfaces.values()), layers)
    yield from _comparison_rows("depth, index, normals, albedo", ", amodal masks", "", times, width * height)
    lit, color = replace(textured, enable_shadows=True), scene.allocate_outputs(color_image="color")
    times = time_view(partial(renderer.render, snapshot, views, out)), time_view(partial(scene.render, lit, hits | color))
    extras = ", indirect light, anti-aliasing, amodal masks, counts, boxes"
    yield from _comparison_rows("color, depth, index", extras, ", one light", times, width * height)


def _comparison_rows(outputs: str, our_extras: str, their_extras: str, times: tuple[float, float], pixels: int) -> Iterator[Row]:
    """Rows of the times of a view [s] of `pixels` pixels by ours and theirs, of their rates, and of their ratio."""
    ours, theirs = times
    for name, seconds in ((f"ours: {outputs}{our_extras}", ours), (f"SensorCamera: {outputs}{their_extras}", theirs)):
        yield Row(name, 1e3 * seconds, "ms")
        yield Row(f"{name}: views", 1.0 / seconds, "1/s")
        yield Row(f"{name}: pixels", 1e-6 * pixels / seconds, "Mpx/s")
    yield Row(f"SensorCamera's time over ours: {outputs}", theirs / ours, "")
