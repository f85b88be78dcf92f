"""Our bins, objects and cameras as scenes of other renderers, Newton's SensorCamera and MuJoCo Warp's ray tracer (all objects are geoms of
the world body), and comparison of their pixels with ours."""

import importlib
from collections.abc import Callable
from dataclasses import replace
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


class SensorScene:
    """Newton model of the worlds of a snapshot's first views, and the inputs with which the sensor renders them."""

    def __init__(
        self,
        render: Render,
        catalog: Catalog,
        fixtures: tuple[Fixture, ...],
        cameras: tuple[Camera, ...],
        table: float,
        snapshot: Snapshot,
        count: int,
        device: Any,
    ) -> None:
        """Build the worlds of the first `count` views, which are ordered by world, then by camera.

        Cameras have equal intrinsics, since the sensor uses the same rays for all views. `table`: height of the table [m], which is built
        if `render.table` is set.
        """
        self.model, segment = _build_model(render, catalog, fixtures, table, snapshot, -(-count // len(cameras)), device)
        self.segment = np.array([*segment, Segment.NOTHING])
        """Segmentation id of each shape (shape + 1) int64; the last one is of pixels without a shape."""
        self.state, self.sensor = self.model.state(), SensorCamera(self.model)
        self.sensor.create_default_light()
        width, height, matrix = cameras[0].width, cameras[0].height, cameras[0].matrix
        intrinsics = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        self.rays: Any = SensorCamera.compute_camera_rays_pinhole_opencv(width, height, *intrinsics, device=device)
        view = np.arange(count)
        transforms = np.array([camera_to_world(camera) for camera in cameras], np.float32)[view % len(cameras)]
        self.transforms = wp.array(transforms, dtype=wp.transformf, device=device)
        self.worlds = wp.array(view // len(cameras), dtype=wp.int32, device=device)
        self.images: dict[str, Any] = {}
        """Outputs of the passes that were prepared last, by argument of the sensor."""

    def prepare(self, color: bool) -> tuple[Callable[[], None], ...]:
        """Passes that render all views, one for each of `ORDERS`: depth and shapes, with `color` textured color by a light with shadows."""
        outputs = {"shape_index_image": "shape_index", "forward_depth_image": "depth_forward"} | ({"color_image": "color"} if color else {})
        size = (len(self.worlds), self.rays.shape[1], self.rays.shape[0])
        self.images = {name: getattr(self.sensor, f"allocate_image_{suffix}")(*size) for name, suffix in outputs.items()}
        return tuple(partial(self._render, replace(order, enable_textures=color, enable_shadows=color)) for order in ORDERS)

    def _render(self, render_config: Any) -> None:
        self.model.bvh_refit_shapes(self.state)
        self.sensor.update(self.state, self.transforms, self.rays, world_indices=self.worlds, render_config=render_config, **self.images)

    def read_hits(self, views: int) -> tuple[np.ndarray, np.ndarray]:
        """Shape of each pixel uint32, the maximum value without one, and planar depth [m] (view, row, column) of the first views."""
        return self.images["shape_index_image"][:views].numpy(), self.images["forward_depth_image"][:views].numpy()


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
    """Agreement of a peer renderer with ours in segmentation and depth: rows of the report.

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


ABSENT = np.array([0.0, 0.0, 1e3, 0.0, 0.0, 0.0, 1.0])
"""Pose of a geom that is absent from its world: above and behind all cameras, since geoms cannot be removed."""
LIGHT_DIRECTION = (-0.4, 0.3, -1.0)
"""Direction of the one light, which casts shadows."""
EXTENT = 10.0
"""Size of the scene [m], from which MuJoCo takes its clipping planes."""
PIXEL_SIZE = 1e-5
"""Size of a pixel of the cameras' sensors [m]; any will do, as only ratios count."""


class RayScene:
    """MuJoCo Warp's model and data for the first worlds of a snapshot; all worlds have the same geoms, each with its own mesh and pose."""

    def __init__(
        self,
        render: Render,
        catalog: Catalog,
        fixtures: tuple[Fixture, ...],
        cameras: tuple[Camera, ...],
        table: float,
        snapshot: Snapshot,
        count: int,
        device: wp.Device,
    ) -> None:
        """Build the worlds of the first `count` views, from the arguments of `SensorScene`."""
        meshes, worlds = [(entry.mesh, entry.material) for entry in catalog.bodies], -(-count // len(cameras))
        self.mujoco, self.mjw = importlib.import_module("mujoco"), importlib.import_module("mujoco_warp")
        self.worlds, self.device, self.cameras = worlds, device, cameras
        host = {name: getattr(snapshot, name).numpy()[:worlds] for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible")}
        used = host["catalog_index"][:, : max(1, int((host["catalog_index"] >= 0).any(axis=0).nonzero()[0].max(initial=0)) + 1)]
        spec, shapes = self.mujoco.MjSpec(), [*meshes, *((fixture.mesh, fixture.material) for fixture in fixtures)]
        spec.stat.extent, spec.visual.headlight.active = EXTENT, 0
        for index, (mesh, material) in enumerate(shapes):
            _add_mesh(self.mujoco, spec, str(index), mesh, material)
        instances = used.shape[1]
        for mesh in (*([0] * instances), *range(len(meshes), len(shapes))):
            spec.worldbody.add_geom(type=self.mujoco.mjtGeom.mjGEOM_MESH, meshname=str(mesh), material=str(mesh), contype=0, conaffinity=0)
        self.segment = np.array([*range(1, 1 + instances), *range(Segment.TOTE, Segment.TOTE + len(fixtures))])
        if render.table:
            plane, color = self.mujoco.mjtGeom.mjGEOM_PLANE, [*render.table_color, 1.0]
            spec.worldbody.add_geom(type=plane, size=[0, 0, 1], pos=[0, 0, table], rgba=color, contype=0, conaffinity=0)
            self.segment = np.append(self.segment, Segment.TABLE)
        self.segment = np.append(self.segment, Segment.NOTHING)
        spec.worldbody.add_light(type=self.mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, 3], dir=LIGHT_DIRECTION, castshadow=True)
        for camera in cameras:
            _add_camera(spec, camera)
        self.model = spec.compile()
        data = self.mujoco.MjData(self.model)
        self.mujoco.mj_forward(self.model, data)
        with wp.ScopedDevice(device):
            self.device_model = self.mjw.put_model(self.model)
            self.data = self.mjw.put_data(self.model, data, nworld=worlds)
            fixture_mesh = np.where(host["fixture_visible"] > 0, np.arange(len(meshes), len(shapes)), -1)
            self._place(np.hstack([used, fixture_mesh]), np.concatenate([host["pose"][:, :instances], host["fixture_pose"]], axis=1))

    def _place(self, mesh: np.ndarray, pose: np.ndarray) -> None:
        """Give each world's geoms their mesh (world, geom), -1: absent, and its pose (world, geom, 7); others stay."""
        count, model = mesh.shape[1], self.model
        placed = np.where((mesh >= 0)[..., None], pose, ABSENT).astype(np.float64)
        mesh = np.maximum(mesh, 0)
        # MuJoCo moves meshes into their frame of inertia.
        rotation = Rotation.from_quat(placed[..., 3:].reshape(-1, 4))
        offset = rotation.apply(model.mesh_pos[mesh].reshape(-1, 3)).reshape(placed[..., :3].shape)
        turned = rotation * Rotation.from_quat(model.mesh_quat[mesh].reshape(-1, 4)[:, [1, 2, 3, 0]])
        position, matrix = self.data.geom_xpos.numpy(), self.data.geom_xmat.numpy()
        position[:, :count] = placed[..., :3] + offset
        matrix[:, :count] = turned.as_matrix().reshape(*mesh.shape, 3, 3)
        self.data.geom_xpos = wp.array(position, dtype=wp.vec3)
        self.data.geom_xmat = wp.array(matrix, dtype=wp.mat33)
        for name, values in (("geom_dataid", mesh), ("geom_matid", mesh)):
            rows = np.tile(getattr(model, name), (self.worlds, 1))
            rows[:, :count] = values
            setattr(self.device_model, name, wp.array(rows.astype(np.int32), dtype=wp.int32))

    def prepare(self, color: bool) -> tuple[Callable[[], None]]:
        """Pass that renders all views: depth and segmentation, and with `color` textured color by one light with shadows."""
        size = (self.cameras[0].width, self.cameras[0].height)
        outputs = {"render_rgb": color, "render_depth": True, "render_seg": True, "use_textures": color, "use_shadows": color}
        with wp.ScopedDevice(self.device):
            self.context = context = self.mjw.create_render_context(self.model, self.worlds, cam_res=size, **outputs)
            self.mjw.refit_bvh(self.device_model, self.data, context)
            # MuJoCo Warp has built the tree of geoms at the origin; one of the geoms where they are is faster.
            context.bvh = wp.Bvh(context.lower, context.upper, groups=context.group, constructor="sah")
            context.bvh_id = context.bvh.id
            worlds = wp.array(np.arange(self.worlds), dtype=wp.int32)
            wp.map(_find_root, wp.full(self.worlds, context.bvh_id, dtype=wp.uint64), worlds, out=context.group_root)
        return (self._render,)

    def _render(self) -> None:
        with wp.ScopedDevice(self.device):
            self.mjw.refit_bvh(self.device_model, self.data, self.context)
            self.mjw.render(self.device_model, self.data, self.context)

    def read_hits(self, views: int) -> tuple[np.ndarray, np.ndarray]:
        """Geom of each pixel uint32, the maximum value without one, and planar depth [m] (view, row, column) of the first views."""
        shape, worlds = (-1, self.cameras[0].height, self.cameras[0].width), -(-views // len(self.cameras))
        geom, depth = self.context.seg_data[:worlds].numpy()[..., 0], self.context.depth_data[:worlds].numpy()
        return geom.reshape(shape)[:views].astype(np.uint32), depth.reshape(shape)[:views]


@wp.func
def _find_root(bvh: wp.uint64, world: wp.int32):
    """`wp.bvh_get_group_root` as a function that `wp.map` can call: root of a world's group after the BVH was rebuilt."""
    return wp.bvh_get_group_root(bvh, world)


def _add_mesh(mujoco: Any, spec: Any, name: str, mesh: TriangleMesh, material: Material) -> None:
    """Add a mesh and a material of this name; MuJoCo gets texture coordinates only with a texture."""
    added = spec.add_mesh(
        name=name,
        uservert=mesh.vertices.reshape(-1).astype(np.float64),
        userface=mesh.faces.reshape(-1),
        usernormal=mesh.normals.reshape(-1).astype(np.float64),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    surface = spec.add_material(name=name, rgba=[*material.color, 1.0])
    if material.texture is not None:
        # MuJoCo's v points down.
        added.usertexcoord = (np.array([[0.0, 1.0]]) + np.array([[1.0, -1.0]]) * mesh.uv).reshape(-1)
        height, width, _ = material.texture.shape
        texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3)
        texture.data = np.ascontiguousarray(material.texture).tobytes()
        surface.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_camera(spec: Any, camera: Camera) -> None:
    """Add a fixed camera with the intrinsics of `camera`."""
    pose, matrix, size = camera_to_world(camera), camera.matrix, np.array([camera.width, camera.height])
    spec.worldbody.add_camera(
        pos=pose[:3],
        quat=pose[[6, 3, 4, 5]],
        resolution=size,
        sensor_size=PIXEL_SIZE * size,
        focal_length=PIXEL_SIZE * np.array([matrix[0, 0], matrix[1, 1]]),
        principal_length=PIXEL_SIZE * (size / 2 - matrix[:2, 2]),
    )
