"""Generalized ICP (Segal, Haehnel and Thrun, RSS 2009) by small_gicp: observed points of a mask against points on the model.

A data set may come from anywhere, so models and textures are read in isolated processes, as a bake reads them.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from synpick_warp.dataset.bop.models import find_models
from synpick_warp.errors import CatalogError, ConfigError, SynpickError
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.catalog import READ_LIMITS
from synpick_warp.scenes.types import Material, TriangleMesh
from synpick_warp.system.processes.isolation import Failure, run_isolated

SPACING = 0.003
"""Grid that both clouds are thinned to [m]: some 1,000 points on a visible side of a can."""
SAMPLES = 20_000
"""Points that are sampled on a model before thinning: several in each cell of the grid, up to 0.1 m² of surface."""
NEIGHBORS = 10
"""Points from which small_gicp estimates a covariance: its default."""
MAX_DISTANCE = 0.03
"""Largest distance of corresponding points [m]: the 2 cm that a start is off, and what 15° add at 4 cm from the origin."""
ITERATIONS = 50
EPSILON = 1e-5
"""Convergence: change of the translation [m], and of the rotation [rad]."""
MIN_POINTS = 20
"""Observed points below which there is no estimate: covariances of NEIGHBORS points need more than that."""
DEPTH_OF_CENTER = 0.5
"""Distance of a start's centre behind the centroid of the observed points, in radii of the model: of a sphere's visible half."""
_MILLIMETRE = 1e-3
_METALLIC, _ROUGHNESS = 0.0, 0.5
"""Of materials, which PLY files do not state; colours are compared, not highlights."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Textured mesh of an object whose pose is estimated."""

    object_id: int
    mesh: TriangleMesh
    """In the axes that poses refer to [m]."""
    material: Material


def read_object_models(folder: Path, object_ids: Iterable[int]) -> list[ObjectModel]:
    """Read the models of objects, ordered by obj_id.

    Args:
        folder: The data set.
        object_ids: Objects that are needed.

    Raises:
        DatasetError: The data set has no models, or an object has none.
        CatalogError: A model or its texture is missing or damaged.
    """
    found = find_models(folder, object_ids, "poses are estimated")
    results = run_isolated(read_mesh, [(path, _MILLIMETRE) for path, _ in found.values()], READ_LIMITS)
    models = []
    for (object_id, (path, _)), result in zip(found.items(), results, strict=True):
        if isinstance(result, Failure):
            raise CatalogError(f"{path}: the process that reads it {result.reason}; repair or simplify the file")
        if isinstance(result, SynpickError):
            raise result
        mesh, given = result
        metallic = _METALLIC if given.metallic is None else given.metallic
        roughness = _ROUGHNESS if given.roughness is None else given.roughness
        models.append(ObjectModel(object_id, mesh, Material(given.color, given.texture, metallic, roughness)))
    return models


class Aligner:
    """Aligns the visible points of objects with their models."""

    def __init__(self, models: Iterable[ObjectModel]) -> None:
        """Prepare points on each model.

        Raises:
            ConfigError: small_gicp is not installed.
        """
        try:
            self._gicp: Any = importlib.import_module("small_gicp")
        except ImportError:
            raise ConfigError("estimate needs small_gicp, which is not installed: pip install 'synpick-warp[gicp]'") from None
        self._models = {model.object_id: self._prepare(model) for model in models}

    def _prepare(self, model: ObjectModel) -> tuple[Any, Any, np.ndarray, float]:
        """Points on the model with covariances, their k-d tree, and centre and radius of its bounding box [m]."""
        mesh = trimesh.Trimesh(model.mesh.vertices.astype(np.float64), model.mesh.faces, process=False)
        points = np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=model.object_id)[0], np.float64)
        low, high = points.min(axis=0), points.max(axis=0)
        return *self._gicp.preprocess_points(points, SPACING, NEIGHBORS, 1), (low + high) / 2, float(np.linalg.norm(high - low)) / 2

    def refine(self, object_id: int, points: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float]:
        """Pose (4, 4) [m] of an object by its observed points (P, 3) in the camera's axes [m], from a start pose.

        Returns:
            Pose, and the fraction of the points that have a partner on the model; the start and 0 where there are too few.
        """
        if len(points) < MIN_POINTS:
            return start, 0.0
        return self._align(object_id, self._gicp.preprocess_points(points, SPACING, NEIGHBORS, 1)[0], start)

    def search(self, object_id: int, points: np.ndarray) -> tuple[np.ndarray, float]:
        """The best refined pose from the 24 rotations of a cube (the octahedral group), centred behind the points; see `refine`."""
        if len(points) < MIN_POINTS:
            return np.eye(4), 0.0
        cloud = self._gicp.preprocess_points(points, SPACING, NEIGHBORS, 1)[0]
        *_, center, radius = self._models[object_id]
        middle = points.mean(axis=0)
        middle = middle * (1.0 + DEPTH_OF_CENTER * radius / max(float(np.linalg.norm(middle)), SPACING))
        starts = np.tile(np.eye(4), (24, 1, 1))
        starts[:, :3, :3] = Rotation.create_group("O").as_matrix()
        starts[:, :3, 3] = middle - starts[:, :3, :3] @ center
        return max((self._align(object_id, cloud, start) for start in starts), key=lambda result: result[1])

    def _align(self, object_id: int, cloud: Any, start: np.ndarray) -> tuple[np.ndarray, float]:
        """Align a thinned cloud; see `refine`."""
        target, tree, *_ = self._models[object_id]
        # The observed part moves onto the whole model, so that every point has a partner.
        result = self._gicp.align(
            target,
            cloud,
            tree,
            np.linalg.inv(start),
            registration_type="GICP",
            max_correspondence_distance=MAX_DISTANCE,
            num_threads=1,
            max_iterations=ITERATIONS,
            rotation_epsilon=EPSILON,
            translation_epsilon=EPSILON,
        )
        if not np.isfinite(result.T_target_source).all():
            return start, 0.0
        return np.linalg.inv(result.T_target_source), result.num_inliers / max(1, cloud.size())
