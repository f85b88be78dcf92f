"""Scene of newton.sensors.SensorCamera: the bins, objects and cameras of our worlds; agreement of another renderer with ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import Render
from synpick_warp.scenes.types import Camera, Catalog, Fixture, Material, TriangleMesh
from synpick_warp.stages.buffers import Snapshot
from tools.options import MeasuredRow

ORDERS = (
    SensorCamera.RenderConfig(),
    SensorCamera.RenderConfig(render_order=SensorCamera.RenderOrder.TILED, tile_width=8, tile_height=4),
)
"""Pixel orders of the sensor: row by row, and in tiles; the faster one is compared."""
OPENGL = np.diag([1.0, -1.0, -1.0])
"""Rotation from OpenGL camera axes (looking along -z, y up) to OpenCV camera axes (looking along +z, y down)."""
DEPTH_TOLERANCE = 1.0
"""Tolerance of depths [counts]: ours is rounded to half a count, the sensor's is computed in world space in single precision."""


@dataclass(eq=False)
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

    images: dict[str, Any] = field(default_factory=dict)
    """Outputs of the passes that were prepared last, by argument of the sensor."""

    def prepare(self, color: bool) -> tuple[Callable[[], None], ...]:
        """Passes that render all views, one for each of `ORDERS`: depth and shapes, and with `color` textured color by one light with
        shadows."""
        outputs = {"shape_index_image": "shape_index", "forward_depth_image": "depth_forward"} | ({"color_image": "color"} if color else {})
        size = (len(self.worlds), self.rays.shape[1], self.rays.shape[0])
        self.images = {name: getattr(self.sensor, f"allocate_image_{suffix}")(*size) for name, suffix in outputs.items()}
        return tuple(partial(self._render, replace(order, enable_textures=color, enable_shadows=color)) for order in ORDERS)

    def _render(self, render_config: Any) -> None:
        """Update the BVH from the state and render all views."""
        self.model.bvh_refit_shapes(self.state)
        self.sensor.update(self.state, self.transforms, self.rays, world_indices=self.worlds, render_config=render_config, **self.images)

    def read_hits(self, views: int) -> tuple[np.ndarray, np.ndarray]:
        """Shape of each pixel uint32, the maximum value without one, and planar depth [m] (view, row, column) of the first views."""
        return self.images["shape_index_image"][:views].numpy(), self.images["forward_depth_image"][:views].numpy()


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
    transforms = np.array([camera_to_world(camera) for camera in cameras], np.float32)[view % len(cameras)]
    return SensorScene(
        model,
        model.state(),
        sensor,
        rays,
        wp.array(transforms, dtype=wp.transformf, device=device),
        wp.array(view // len(cameras), dtype=wp.int32, device=device),
        np.array([*segment, Segment.NOTHING]),
    )


def camera_to_world(camera: Camera) -> np.ndarray:
    """Pose x, y, z [m], quaternion x, y, z, w (7) of the camera in OpenGL axes."""
    rotation = camera.rotation.T
    return np.concatenate([-rotation @ camera.translation, Rotation.from_matrix(rotation @ OPENGL).as_quat()])


def _build_model(
    render: Render, catalog: Catalog, fixtures: tuple[Fixture, ...], table: float, snapshot: Snapshot, count: int, device: Any
) -> tuple[newton.Model, list[int]]:
    """Build the Newton model of the first `count` worlds; returns it with the segmentation id of each shape."""
    objects = [(newton_mesh(entry.mesh, entry.material), entry.material) for entry in catalog.bodies]
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


def compare_hits(
    ids: np.ndarray, index: np.ndarray, depth: np.ndarray, segment: np.ndarray, counts: np.ndarray, scale: float
) -> list[MeasuredRow]:
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
        MeasuredRow("pixels with the same instance in both", 100.0 * float(same.mean()), "%"),
        MeasuredRow(f"pixels with the same instance and depth within {DEPTH_TOLERANCE * scale:g} mm", 100.0 * float(close.mean()), "%"),
        MeasuredRow("largest difference of depths of the same instance", largest, "mm"),
    ]
