"""Shapes, materials, lights and cameras of small analytic scenes; poses are x, y, z [m] and a quaternion x, y, z, w."""

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from synpick_warp.configs.calibration.lens import PINHOLE, Lens, LensMap
from synpick_warp.scenes.assets.appearance import linear_to_srgb
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import Camera, CatalogEntry, EnvironmentMap, Material, TriangleMesh

GREY = Material(color=(0.7, 0.7, 0.7), texture=None, metallic=0.0, roughness=0.8)
DOWN = np.diag([1.0, -1.0, -1.0])
"""World to camera of a camera that looks down; up in the image is +y."""
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
FLAT = (0.0, 0.0, 0.0, *UPRIGHT)
"""Pose at the origin."""
WHITE = (1.0, 1.0, 1.0)
HALF = (float(linear_to_srgb(0.5)),) * 3
"""Colour of a linear albedo of 0.5."""


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


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Rotation matrix (3, 3)."""
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return rotation * np.linalg.det(rotation)


def random_pose(rng: np.random.Generator, low: Any = (-0.1, -0.1, -0.1), high: Any = (0.1, 0.1, 0.1)) -> tuple[float, ...]:
    """Position between two corners [m], and any rotation."""
    quaternion, position = rng.normal(size=4), rng.uniform(low, high)
    return (*position, *(quaternion / np.linalg.norm(quaternion)))


def random_pile(rng: np.random.Generator, meshes: int, count: int, low: Any, high: Any) -> list[tuple[int, tuple[float, ...]]]:
    """Random objects, as mesh index and pose, in an axis-aligned box given by two corners [m]."""
    return [(int(rng.integers(meshes)), pose) for pose in (random_pose(rng, low, high) for _ in range(count))]
