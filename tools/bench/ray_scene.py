"""Scene of MuJoCo Warp's ray renderer: the bins, objects and cameras of our worlds, as geoms without bodies."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import Render
from synpick_warp.scenes.types import Camera, Catalog, Fixture, Material, TriangleMesh
from synpick_warp.stages.buffers import Snapshot
from tools.bench.sensor import camera_to_world

ABSENT = np.array([0.0, 0.0, 1e3, 0.0, 0.0, 0.0, 1.0])
"""Pose of a geom that its world lacks: above and behind all cameras, since a geom cannot be left out."""
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
        """Build the worlds of the first `count` views, from the arguments of `build_sensor_scene`."""
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
        """Refit the tree to the geoms and render all views."""
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
    """Root of a world's group in a grouped BVH."""
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
