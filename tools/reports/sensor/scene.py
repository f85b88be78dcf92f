"""Annotated frames as scenes of the renderer: models at their poses on a plane that is fitted to the measured surroundings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.configs.cell.sensors import DepthSensor
from synpick_warp.configs.schema import Config
from synpick_warp.errors import DatasetError
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, Material, TriangleMesh
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers, view_buffer_sizes
from synpick_warp.stages.render.layers import sensor_parameters
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.system.hardware.device import pick_device, start_warp
from tools.reports.real_frames import DEPTH_SCALE, RealFrame

METRES = 1e-4
"""Depth of one count [m]."""
_MILLIMETRE = 1e-3
_LAYERS = ("normals", "albedo", "depth_sensor")
_PLANE_SIZE = 6.0
"""Side of the plane under the objects [m]."""
_SUPPORT = 0.008
"""Largest distance of the points that count for a plane [m]."""
_TRIALS = 400
"""Planes that are tried through three random points (RANSAC, Fischler and Bolles, 1981)."""
_MARGIN = 8
"""Distance to the objects' masks from which on pixels may show the plane [px]."""
_UPRIGHT = np.eye(3)


@dataclass(frozen=True, eq=False)
class Rendered:
    """Rendered images of F frames (F, H, W): ground truth, and depth of the simulated sensor."""

    depth: np.ndarray
    """Planar depth float32 [m]; inf: nothing is there."""
    owner: np.ndarray
    """Index of the object in the frame, int16: -1 for the plane, -2 for nothing."""
    normal: np.ndarray
    """Surface normal in the camera's axes (F, H, W, 3) float32, towards the camera."""
    cosine: np.ndarray
    """Cosine of the angle of incidence float32."""
    albedo: np.ndarray
    """Albedo float32: mean of the three channels of the base colour, sRGB, from 0 to 1."""
    sensor: np.ndarray
    """Measured depth uint16 [0.1 mm]; 0: a hole."""


def back_project(frame: RealFrame, depth: np.ndarray) -> np.ndarray:
    """Points (H, W, 3) [unit of `depth`] of planar depth (H, W), in the camera's axes."""
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]]
    fx, fy, cx, cy = frame.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    return np.stack([(columns + 0.5 - cx) / fx * depth, (rows + 0.5 - cy) / fy * depth, depth], axis=-1)


def fit_plane(frame: RealFrame) -> tuple[np.ndarray, float]:
    """Fit a plane to the measured points outside of the objects (RANSAC, then least squares on inliers).

    Returns:
        Unit normal n towards the camera, and n · x [m].
    """
    outside = cv2.dilate((frame.label > 0).astype(np.uint8), np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8)) == 0
    points = back_project(frame, METRES * frame.depth.astype(np.float64))[outside & (frame.depth > 0)]
    rng = np.random.default_rng([frame.sequence, frame.image])
    sample = points[rng.integers(len(points), size=5000)]
    corners = sample[rng.integers(len(sample), size=(_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    corners, normals = corners[length[:, 0] > 0.0], normals[length[:, 0] > 0.0] / length[length[:, 0] > 0.0]
    off = np.abs(sample @ normals.T - (normals * corners[:, 0]).sum(axis=1))
    best = int(np.argmax((off < _SUPPORT).sum(axis=0)))
    normal, height = normals[best], float(normals[best] @ corners[best, 0])
    for _ in range(5):
        near = points[np.abs(points @ normal - height) < _SUPPORT]
        center = near.mean(axis=0)
        normal = np.linalg.svd((near - center).T @ (near - center))[2][2]
        height = float(normal @ center)
    return (normal, height) if normal[2] < 0.0 else (-normal, -height)


class RealScenes:
    """Renders annotated frames, one world each, on the CPU."""

    def __init__(self, frames: Sequence[RealFrame], models: Path) -> None:
        """Load models, and fit the planes; raises `SynpickError` for models that are missing or damaged, and frames of other intrinsics."""
        if any(not np.allclose(frame.intrinsics, frames[0].intrinsics) for frame in frames):
            raise DatasetError("the frames differ in intrinsics; name those of one camera")
        start_warp()
        self.frames = tuple(frames)
        self.planes = [fit_plane(frame) for frame in frames]
        self.object_ids = sorted({index for frame in frames for index in frame.object_ids})
        self._device = pick_device("cpu")
        self._slots = 1 + max(len(frame.object_ids) for frame in frames)
        self._config = Config().with_values({"render.layers": _LAYERS, "render.table": False, "bop.depth_scale": DEPTH_SCALE})
        entries = [_entry(index, *read_mesh(models / f"obj_{index:06d}.ply", _MILLIMETRE)[:1]) for index in self.object_ids]
        entries = [replace(entry, material=_material(models, entry.obj_id)) for entry in entries]
        entries.append(_entry(1 + max(self.object_ids), _sheet()))
        height, width = frames[0].depth.shape
        camera = Camera(width, height, frames[0].intrinsics, _UPRIGHT, np.zeros(3))
        fixtures = make_fixtures(make_bins(self._config.cell.bins), self._config.gripper)
        self._scene = build_render_scene(
            self._config.render, 0.0, Catalog(tuple(entries)), fixtures, (camera,), load_lights("")[:1], self._device
        )
        self._fixtures = len(fixtures)
        self._renderer = make_renderer(self._config, self._scene, self._slots, len(frames), colors=False)

    def render(self, poses: Sequence[np.ndarray], sensor: DepthSensor, seed: int = 0) -> Rendered:
        """Render all frames.

        Args:
            poses: Of each frame, object to camera (N, 4, 4) [m].
            sensor: Settings of the simulated sensor.
            seed: Seed of its noise.
        """
        count, device = len(self.frames), self._device
        world = allocate(Snapshot, {"world": count, "instance": self._slots, "fixture": self._fixtures}, device)
        catalog, placed = np.full((count, self._slots), -1), np.zeros((count, self._slots, 7), np.float32)
        for row, (frame, plane) in enumerate(zip(self.frames, self.planes, strict=True)):
            catalog[row, 0], placed[row, 0] = len(self.object_ids), _transform(_plane_pose(*plane))
            for slot, (index, pose) in enumerate(zip(frame.object_ids, poses[row], strict=True)):
                catalog[row, 1 + slot], placed[row, 1 + slot] = self.object_ids.index(index), _transform(pose)
        world.catalog_index.assign(catalog)
        world.pose.assign(placed)
        world.fixture_visible.zero_()
        world.episode.assign(np.arange(count))
        sizes = view_buffer_sizes(count, self._scene.width, self._scene.height, self._slots)
        images, layers = allocate(ViewBuffers, sizes, device), allocate(LayerBuffers, sizes, device, _LAYERS)
        self._renderer.layer_renderer.sensor = sensor_parameters(sensor, seed, DEPTH_SCALE)
        rows = wp.array(np.arange(count), dtype=wp.int32, device=device)
        self._renderer.render(world, make_views(rows, wp.zeros_like(rows), count, self._slots), images, layers)
        owner = images.instance.numpy().astype(np.int16) - 2
        depth = self._renderer.gbuffer.depth.numpy()[:, : self._scene.height, : self._scene.width]
        normals = layers.normals.numpy().astype(np.float32)
        rays = back_project(self.frames[0], np.ones(depth.shape[1:]))
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return Rendered(
            depth=np.where(owner > -2, depth, np.inf).astype(np.float32),
            owner=owner,
            normal=normals,
            cosine=np.abs((normals * rays).sum(axis=-1)),
            albedo=layers.albedo.numpy().astype(np.float32).mean(axis=-1) / 255.0,
            sensor=layers.depth_sensor.numpy().copy(),
        )


def annotated_poses(frame: RealFrame) -> np.ndarray:
    """Poses of a frame's annotation, object to camera (N, 4, 4) [m]."""
    poses = np.tile(np.eye(4), (len(frame.object_ids), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = frame.rotations, _MILLIMETRE * frame.translations
    return poses


def _material(models: Path, obj_id: int) -> Material:
    """Material of a model's file."""
    given = read_mesh(models / f"obj_{obj_id:06d}.ply", _MILLIMETRE)[1]
    return Material(given.color, given.texture, 0.0, 0.5)


def _entry(obj_id: int, mesh: TriangleMesh) -> CatalogEntry:
    """Grey catalog entry for rendering, without physics."""
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    grey = Material((0.6, 0.6, 0.6), None, 0.0, 0.5)
    return CatalogEntry(obj_id, "", mesh, grey, (), 1e-3, radius, 1.0, np.zeros(3), np.eye(3), 2.0 * radius, (), (), None)


def _sheet() -> TriangleMesh:
    """Square about the origin that faces +z."""
    half = 0.5 * _PLANE_SIZE
    return TriangleMesh(
        vertices=np.array([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)], np.float32),
        faces=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        uv=np.zeros((4, 2), np.float32),
    )


def _plane_pose(normal: np.ndarray, height: float) -> np.ndarray:
    """Pose (4, 4) [m] that puts the square onto a plane, below the middle of the picture."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.align_vectors(normal[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    pose[:3, 3] = np.array([0.0, 0.0, height / normal[2]])
    return pose


def _transform(pose: np.ndarray) -> np.ndarray:
    """Position and quaternion x, y, z, w (7) float32 of a matrix (4, 4)."""
    return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()]).astype(np.float32)
