"""Ray casting in float64: a reference G-buffer, hits of rays on a mesh; and whether a mesh is closed and consistently oriented."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from synpick_warp.scenes.types import Camera, TriangleMesh


def rotation_of(quaternion: ArrayLike) -> np.ndarray:
    """Rotation matrix (3, 3) of a quaternion x, y, z, w, which is normalized first."""
    return Rotation.from_quat(np.asarray(quaternion, np.float64)).as_matrix()


def cast_mesh(mesh: TriangleMesh, pose: np.ndarray, camera: Camera) -> np.ndarray:
    """Planar depth of the closest hit of each pixel's ray (H, W) float64 [m]; inf: a miss.

    Every triangle must lie in front of the camera. A triangle with corners a, b, c in the camera's axes and a ray d = (x, y, 1):
    z = a·n / d·n with n = (b - a) x (c - a), inside where the three determinants det(d, a, b), det(d, b, c), det(d, c, a) agree.
    """
    pose = np.asarray(pose, dtype=np.float32).astype(np.float64)
    world = mesh.vertices.astype(np.float64) @ rotation_of(pose[3:]).T + pose[:3]
    points = world @ camera.rotation.T + camera.translation
    assert points[:, 2].min() > 0.0
    fx, fy, cx, cy = camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2], camera.matrix[1, 2]
    pixels = np.stack([points[:, 0] / points[:, 2] * fx + cx, points[:, 1] / points[:, 2] * fy + cy], axis=1)
    corners = pixels[mesh.faces]
    low = np.clip(np.floor(corners.min(axis=1)).astype(int) - 1, 0, [camera.width, camera.height])
    high = np.clip(np.ceil(corners.max(axis=1)).astype(int) + 1, 0, [camera.width, camera.height])
    # A row for each pair of a triangle and a pixel in its box.
    width = np.maximum(high[:, 0] - low[:, 0], 0)
    pixels = width * np.maximum(high[:, 1] - low[:, 1], 0)
    face = np.repeat(np.arange(len(pixels)), pixels)
    index = np.arange(len(face)) - np.repeat(np.cumsum(pixels) - pixels, pixels)
    column, row = low[face, 0] + index % width[face], low[face, 1] + index // width[face]
    ray = np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(len(face))], axis=1)
    a, b, c = points[mesh.faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    sides = [(side[face] * ray).sum(axis=1) for side in (np.cross(a, b), np.cross(b, c), np.cross(c, a))]
    inside = np.logical_and.reduce([side >= 0 for side in sides]) | np.logical_and.reduce([side <= 0 for side in sides])
    facing = (normal[face] * ray).sum(axis=1)
    inside &= facing != 0.0
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (row[inside], column[inside]), (a * normal).sum(axis=1)[face[inside]] / facing[inside])
    return depth


def cast_scene(meshes: list[TriangleMesh], poses: list[np.ndarray], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (H, W) float64 [m], inf: a miss; segmentation ids (H, W), 0 or 1 + index; amodal masks (N, H, W) bool."""
    depths = np.stack([cast_mesh(mesh, pose, camera) for mesh, pose in zip(meshes, poses, strict=True)])
    depth = depths.min(axis=0)
    instance = np.where(np.isfinite(depth), 1 + depths.argmin(axis=0), 0).astype(np.uint8)
    return depth, instance, np.isfinite(depths)


def first_hit(vertices: np.ndarray, faces: np.ndarray, origin: ArrayLike, direction: ArrayLike) -> np.ndarray:
    """Distances (...) to the nearest triangle from points (..., 3) along unit directions (Möller and Trumbore, 1997); infinity: a miss."""
    corners = vertices[faces].astype(np.float64)
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    along = np.asarray(direction, np.float64)[..., None, :]
    p = np.cross(along, edge2)
    det = (edge1 * p).sum(axis=-1)
    usable = np.abs(det) > 1e-14
    inverse = 1.0 / np.where(usable, det, 1.0)
    t = np.asarray(origin, np.float64)[..., None, :] - corners[:, 0]
    u = (t * p).sum(axis=-1) * inverse
    q = np.cross(t, edge1)
    v = (q * along).sum(axis=-1) * inverse
    distance = (edge2 * q).sum(axis=-1) * inverse
    hit = usable & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (distance > 0)
    return np.where(hit, distance, np.inf).min(axis=-1)


def edges_match(faces: np.ndarray) -> bool:
    """True if each directed edge has exactly one opposite: the mesh is closed and consistently oriented."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    codes = edges[:, 0] * (faces.max() + 1) + edges[:, 1]
    opposite = edges[:, 1] * (faces.max() + 1) + edges[:, 0]
    return len(np.unique(codes)) == len(codes) and np.array_equal(np.sort(codes), np.sort(opposite))
