"""Object models on the device: meshes for closest points, surface samples with normals and colours, and near-symmetries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from synpick_warp.kernels.pose.hypotheses import Symmetries
from synpick_warp.kernels.pose.residuals import Models
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.types import Material, TriangleMesh
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.pose.batch import ObjectModel
from synpick_warp.stages.render.scene import mip_levels
from synpick_warp.system.low_discrepancy import sample_triangles

SAMPLES = 2048
"""Surface samples of a model: 3 mm apart on a can, 6 mm on a large box."""
TEXELS = 96
"""Resolution of sample colours: a texel of the mip level is at most a diameter over this, about a crop pixel."""
SYMMETRY_STEP = 15.0
"""Step of the angles about an object's principal axes that are tried as near-symmetries [°]."""
SYMMETRY_TOLERANCE = 0.025
"""Largest mean distance of the rotated surface from the surface for a near-symmetry, relative to the diameter."""
MAX_SYMMETRIES = 72

MODELS = struct_arrays(
    Models,
    "model",
    position=("model", "sample"),
    normal=("model", "sample"),
    color=("model", "sample"),
    units={"radius": "m", "sample_area": "m²", "position": "m"},
)
SYMMETRIES = struct_arrays(Symmetries, "model", rotation=("model", "symmetry"), units={"center": "m"})


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Samples of a surface: positions [m], outward normals, linear base colours, in an order of which every prefix is evenly spread; and
    the surface's area [m²].
    """

    position: np.ndarray
    """(S, 3) float32 [m]."""
    normal: np.ndarray
    """Outward unit normals of the triangles (S, 3) float32."""
    color: np.ndarray
    """Base colour (S, 3) float32, linear."""
    area: float
    """Area of the surface [m²]."""


@dataclass(frozen=True, eq=False)
class PoseModels:
    """Meshes, surface samples, near-symmetries and diameters of the object models, on the device."""

    models: Any
    """The struct `Models`."""
    symmetries: Any
    """The struct `Symmetries`."""
    objects: tuple[ObjectModel, ...]
    diameters: np.ndarray
    """Diameter of each model's bounding sphere about its origin (model) float64 [m]."""
    meshes: tuple[wp.Mesh, ...]
    """Owners of the meshes whose handles `models` holds."""


def build_models(objects: Sequence[ObjectModel], device: wp.Device, samples: int = SAMPLES) -> PoseModels:
    """Sample the surfaces of objects, find their near-symmetries and upload both."""
    surfaces = [sample_surface(item.mesh, item.material, samples) for item in objects]
    centers = [surface.position.mean(axis=0) for surface in surfaces]
    symmetries = [near_symmetries(surface.position) for surface in surfaces]
    radii = np.array([np.linalg.norm(item.mesh.vertices, axis=1).max() for item in objects])
    meshes = tuple(
        wp.Mesh(
            points=wp.array(item.mesh.vertices, dtype=wp.vec3, device=device),
            indices=wp.array(item.mesh.faces.reshape(-1), dtype=wp.int32, device=device),
            bvh_constructor="sah",
            bvh_leaf_size=1,
        )
        for item in objects
    )
    models = allocate_struct(MODELS, {"model": len(objects), "sample": samples}, device)
    models.mesh.assign(np.array([mesh.id for mesh in meshes], np.uint64))
    models.radius.assign(radii.astype(np.float32))
    models.sample_area.assign(np.array([surface.area / samples for surface in surfaces], np.float32))
    for name in ("position", "normal", "color"):
        getattr(models, name).assign(np.stack([getattr(surface, name) for surface in surfaces]))
    table = allocate_struct(SYMMETRIES, {"model": len(objects), "symmetry": max(len(symmetry) for symmetry in symmetries)}, device)
    rotation = np.zeros((*table.rotation.shape, 4), np.float32)
    rotation[..., 3] = 1.0
    for row, symmetry in enumerate(symmetries):
        rotation[row, : len(symmetry)] = symmetry
    table.rotation.assign(rotation)
    table.count.assign(np.array([len(symmetry) for symmetry in symmetries], np.int32))
    table.center.assign(np.array(centers, np.float32))
    return PoseModels(models, table, tuple(objects), 2.0 * radii, meshes)


def sample_surface(mesh: TriangleMesh, material: Material, count: int) -> SurfaceSamples:
    """Sample a surface evenly by area: low-discrepancy points of its triangles (see `sample_triangles`), with normal and colour."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(doubled, axis=1)
    face, weights = sample_triangles(areas, count)
    position = np.einsum("sk,skc->sc", weights, corners[face])
    normal = doubled[face] / np.linalg.norm(doubled[face], axis=1, keepdims=True)
    uv = np.einsum("sk,skc->sc", weights, mesh.uv[mesh.faces[face]].astype(np.float64))
    color = sample_color(mesh, material, uv)
    return SurfaceSamples(position.astype(np.float32), normal.astype(np.float32), color, float(np.cumsum(areas)[-1]))


def sample_color(mesh: TriangleMesh, material: Material, uv: np.ndarray) -> np.ndarray:
    """Base colour (S, 3) float32, linear, at texture coordinates (S, 2): the mip level whose texels are as wide as a crop pixel."""
    factor = srgb_to_linear(np.array(material.color))
    if material.texture is None:
        return np.broadcast_to(factor, (len(uv), 3)).astype(np.float32)
    corners, flat = mesh.vertices[mesh.faces].astype(np.float64), mesh.uv[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    edge, other = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    uv_area = np.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]).sum()
    diameter = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    width = np.sqrt(area / max(uv_area, 1e-12) / (material.texture.shape[0] * material.texture.shape[1]))
    levels = mip_levels(material.texture)
    level = levels[int(np.clip(np.floor(np.log2(max(diameter / TEXELS / width, 1.0))), 0, len(levels) - 1))]
    height, columns = level.shape[:2]
    column = np.clip(np.floor(np.mod(uv[:, 0], 1.0) * columns), 0, columns - 1).astype(np.int64)
    row = np.clip(np.floor((1.0 - np.mod(uv[:, 1], 1.0)) * height), 0, height - 1).astype(np.int64)
    return (srgb_to_linear(level[row, column] / 255.0) * factor).astype(np.float32)


def near_symmetries(points: np.ndarray) -> np.ndarray:
    """Near-symmetries: rotations about the centroid that keep a surface nearly in place, about principal axes in steps, and half-turns.

    Args:
        points: Samples of the surface (S, 3).

    Returns:
        Quaternions (T, 4) float32, x y z w; the first is the identity.
    """
    centered = points.astype(np.float64) - points.mean(axis=0)
    tree = KDTree(centered)
    probes = centered[:256]
    size = 2.0 * np.linalg.norm(centered, axis=1).max()
    # Distances between samples alone are not zero: what the identity would have if its own sample did not count.
    spacing = tree.query(probes, k=2)[0][:, 1].mean()
    axes = np.linalg.svd(centered, full_matrices=False)[2]
    angles = np.deg2rad(np.arange(SYMMETRY_STEP, 360.0, SYMMETRY_STEP))
    vectors = [angle * axis for axis in axes for angle in angles]
    # Half-turns about all axes across a principal one: where two principal moments are equal, their axes are arbitrary.
    for first, second in ((0, 1), (1, 2), (2, 0)):
        vectors += [np.pi * (np.cos(angle) * axes[first] + np.sin(angle) * axes[second]) for angle in angles[angles < np.pi]]
    candidates = Rotation.from_rotvec(vectors)
    distances = tree.query(np.einsum("tij,pj->tpi", candidates.as_matrix(), probes))[0]
    kept = candidates[distances.mean(axis=1) < spacing + SYMMETRY_TOLERANCE * size]
    flips = kept[np.isclose(kept.magnitude(), np.pi)]
    rotations = [Rotation.identity().as_quat()[None], kept.as_quat()]
    rotations += [(flips * symmetry).as_quat() for symmetry in kept if len(flips)]
    return distinct_rotations(np.concatenate(rotations), np.deg2rad(SYMMETRY_STEP) / 2.0, MAX_SYMMETRIES).astype(np.float32)


def distinct_rotations(quaternions: np.ndarray, angle: float, limit: int) -> np.ndarray:
    """Non-maximum suppression of rotations in their order: each one kept is farther than `angle` [rad] from those kept before it.

    Args:
        quaternions: Unit quaternions (N, 4), the best first.
        angle: Smallest angle between two that are kept [rad].
        limit: Maximum number that is kept.
    """
    kept = np.empty((0, 4))
    for quaternion in quaternions:
        # Opposite quaternions are one rotation.
        if (np.abs(kept @ quaternion) < np.cos(angle / 2.0)).all():
            kept = np.concatenate((kept, quaternion[None]))
            if len(kept) == limit:
                break
    return kept
