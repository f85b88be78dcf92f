"""RGB-D views for pose estimation: drawn in NumPy with known answers, or rendered by the project's renderer.

The cameras stand at the origin and look along +z, so that poses are those from object to camera.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.scenes.assets.appearance import linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.types import Material, TriangleMesh
from synpick_warp.stages.pose.batch import InstanceTable, ObjectModel, RgbdBatch
from synpick_warp.stages.pose.observe import Observer
from tests.worlds import toy_scene

COUNT = 2e-5
"""Depth of a count of drawn views [m]: fine, so that rounding does not hide errors."""
RENDERED_COUNT = 1e-4
"""Depth of a count of rendered views [m]: the renderer's default."""
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
WALL = 1.1
"""Distance of the wall behind rendered objects [m]."""
FACING = (1.0, 0.0, 0.0, 0.0)
"""Half a turn about x: a sheet's front, which is +z, faces the camera."""


def intrinsics(width: int, height: int, focal: float) -> np.ndarray:
    """fx, fy, cx, cy (4,) float32 with the principal point in the middle."""
    return np.array([focal, focal, width / 2.0, height / 2.0], np.float32)


def rays(width: int, height: int, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """x / z and y / z (H, W) at the centres of the pixels."""
    return np.meshgrid((np.arange(width) + 0.5 - width / 2.0) / focal, (np.arange(height) + 0.5 - height / 2.0) / focal)


def drawn(label: np.ndarray, depth: np.ndarray, focal: float, color: np.ndarray | None = None) -> RgbdBatch:
    """Batch of one view from labels (H, W), depth (H, W) [m] (0: none) and linear RGB (H, W, 3), by default mid-grey."""
    height, width = label.shape
    linear = np.full((height, width, 3), 0.2) if color is None else color
    return RgbdBatch(
        color=np.rint(linear_to_srgb(linear) * 255.0).astype(np.uint8)[None],
        depth=np.rint(depth / COUNT).astype(np.uint16)[None],
        depth_scale=np.array([COUNT], np.float32),
        label=label.astype(np.uint8)[None],
        intrinsics=intrinsics(width, height, focal)[None],
    )


def joined(*batches: RgbdBatch) -> RgbdBatch:
    """The views of several batches in one."""
    return RgbdBatch(**{name: np.concatenate([getattr(batch, name) for batch in batches]) for name in vars(batches[0])})


def table_of(*rows: tuple[int, int, int]) -> InstanceTable:
    """Instances (view, slot, model)."""
    view, slot, model = np.array(rows, np.int32).reshape(-1, 3).T
    return InstanceTable(view.copy(), slot.copy(), model.copy())


def observe(batch: RgbdBatch, table: InstanceTable, device: wp.Device, points: int = 256) -> Observer:
    """Observer that has seen a batch."""
    views, height, width = batch.label.shape
    observer = Observer(table, views, height, width, points, device)
    observer.observe(batch)
    return observer


def model_of(mesh: TriangleMesh, material: Material = toy_scene.GREY, object_id: int = 1) -> ObjectModel:
    """An object without listed symmetries."""
    return ObjectModel(object_id, mesh, material, (), ())


@cache
def embedded(*object_ids: int) -> tuple[ObjectModel, ...]:
    """Embedded objects. They are matt here: the estimator's model of light has no gloss."""
    found = {item.obj_id: item for item in procedural_objects()}
    return tuple(
        ObjectModel(
            index,
            found[index].mesh,
            Material((1.0, 1.0, 1.0), found[index].material.texture, 0.0, 0.8),
            found[index].symmetries_discrete,
            found[index].symmetries_continuous,
        )
        for index in object_ids
    )


def smooth_texture(seed: int, rows: int, columns: int, cells: int = 8) -> np.ndarray:
    """Linear RGB (rows, columns, 3) from 0.05 to 0.9 that varies smoothly over `cells` cells."""
    noise = np.random.default_rng(seed).uniform(0.05, 0.9, (cells, cells, 3))
    return np.clip(cv2.resize(noise, (columns, rows), interpolation=cv2.INTER_CUBIC), 0.05, 0.9)


def as_material(texture: np.ndarray) -> Material:
    """Matt material of a linear texture."""
    return Material((1.0, 1.0, 1.0), np.rint(linear_to_srgb(texture) * 255.0).astype(np.uint8), 0.0, 0.8)


def plate_view(
    size: tuple[float, float], distance: float, focal: float, shape: tuple[int, int], texture: np.ndarray, wall: float = 0.3
) -> RgbdBatch:
    """A textured sheet that faces the camera, centred on its axis, before an even wall; the texture's values are what the camera sees.

    Args:
        size: Width and height of the sheet [m].
        distance: Of the sheet [m]; the wall is 0.2 m behind.
        focal: Focal length [px].
        shape: Rows and columns of the image.
        texture: Linear RGB (rows, columns, 3) over the sheet, top row at the image's top.
        wall: Its intensity.
    """
    height, width = shape
    x, y = rays(width, height, focal)
    u, v = x * distance / size[0] + 0.5, y * distance / size[1] + 0.5
    label = (u >= 0.0) & (u < 1.0) & (v >= 0.0) & (v < 1.0)
    encoded = srgb_to_linear(as_material(texture).texture / 255.0).astype(np.float32)
    columns, rows = u * texture.shape[1] - 0.5, v * texture.shape[0] - 0.5
    seen = cv2.remap(encoded, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    color = np.where(label[..., None], seen, wall)
    return drawn(label, np.where(label, distance, distance + 0.2), focal, color)


def rendered(
    objects: tuple[ObjectModel, ...],
    placed: list[list[tuple[int, np.ndarray]]],
    device: wp.Device,
    shape: tuple[int, int] = (180, 320),
    focal: float = 330.0,
) -> RgbdBatch:
    """Views by the project's renderer under a sky with a direction, before a grey wall at WALL.

    Args:
        objects: The models.
        placed: (model, pose (7,)) of the instances of each view, in the order of the slots; further ones than a table names are clutter.
        device: Where to render.
        shape: Rows and columns.
        focal: Focal length [px].
    """
    height, width = shape
    camera = toy_scene.camera(width, height, focal, (0.0, 0.0, 0.0), np.eye(3))
    wall = (len(objects), (0.0, 0.0, WALL, *UPRIGHT))
    scene = toy_scene.ToyScene(
        entries=[*(toy_scene.entry(item.mesh, item.material) for item in objects), toy_scene.entry(toy_scene.box(3.0, 3.0, 0.01))],
        placed=[[*((model, tuple(float(value) for value in pose)) for model, pose in view), wall] for view in placed],
        cameras=(camera,),
        lights=(_sky(),),
        light_exposure=-1.5,
        instances=1 + max(len(view) for view in placed),
    )
    images = toy_scene.render(scene, device)
    views = len(placed)
    return RgbdBatch(
        color=images.color,
        depth=images.depth,
        depth_scale=np.full(views, RENDERED_COUNT, np.float32),
        label=images.instance,
        intrinsics=np.tile(intrinsics(width, height, focal), (views, 1)),
    )


def _sky():
    """Soft light, brightest behind the camera, which looks along +z, and from its left."""
    rows = 16
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = ((np.arange(2 * rows) + 0.5) / rows - 1.0) * np.pi
    z, x = np.cos(polar)[:, None], np.sin(polar)[:, None] * np.cos(azimuth)[None]
    radiance = np.clip(0.4 - 0.25 * z - 0.15 * x, 0.0, None).astype(np.float32)
    return toy_scene.EnvironmentMap("soft", np.repeat(radiance[..., None], 3, axis=2))


def pose_of(position: tuple[float, float, float], rotation: Rotation) -> np.ndarray:
    """Pose (7,) float32."""
    return np.concatenate([position, rotation.as_quat()]).astype(np.float32)


def disturbed(pose: np.ndarray, random: np.random.Generator, distance: float = 0.02, angle: float = 15.0) -> np.ndarray:
    """Poses (N, 7) moved by exactly `distance` [m] and turned by `angle` [°] in random directions."""
    shift, axis = random.normal(size=(2, len(pose), 3))
    shift *= distance / np.linalg.norm(shift, axis=1, keepdims=True)
    axis *= np.deg2rad(angle) / np.linalg.norm(axis, axis=1, keepdims=True)
    turned = Rotation.from_rotvec(axis) * Rotation.from_quat(pose[:, 3:])
    return np.concatenate([pose[:, :3] + shift, turned.as_quat()], axis=1).astype(np.float32)


def pose_errors(estimated: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the origins (N,) [m] and angles between the rotations (N,) [°]."""
    angle = (Rotation.from_quat(estimated[:, 3:]) * Rotation.from_quat(true[:, 3:]).inv()).magnitude()
    return np.linalg.norm(estimated[:, :3] - true[:, :3], axis=1), np.rad2deg(angle)
