"""GICP baseline on the CPU (Segal, Haehnel and Thrun, RSS 2009) by small_gicp: observed points of a mask against points on the model."""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import trimesh

from synpick_warp.apps.estimation.methods import to_rotations, to_transforms
from synpick_warp.errors import ConfigError
from synpick_warp.stages.pose.batch import Estimates, InstanceTable, ObjectModel, RgbdBatch

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


def load_small_gicp() -> Any:
    """Import small_gicp.

    Raises:
        ConfigError: It is not installed.
    """
    try:
        return importlib.import_module("small_gicp")
    except ImportError:
        raise ConfigError("--method gicp needs small_gicp, which is not installed: pip install 'synpick-warp[gicp]'") from None


class GicpEstimator:
    """`Estimator` that only refines; instances run in parallel threads."""

    def __init__(self, models: Sequence[ObjectModel], instances: InstanceTable, threads: int) -> None:
        """
        Args:
            models: Models by index.
            instances: Instances that are refined.
            threads: Number of threads.

        Raises:
            ConfigError: small_gicp is not installed.
        """
        self._gicp = load_small_gicp()
        self._instances, self._threads = instances, max(1, threads)
        self._targets = {index: self._prepare(models[index]) for index in np.unique(instances.model).tolist()}

    def _prepare(self, model: ObjectModel) -> tuple[Any, Any]:
        """Points on the model with covariances, and their k-d tree."""
        mesh = trimesh.Trimesh(model.mesh.vertices.astype(np.float64), model.mesh.faces, process=False)
        points = np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=model.object_id)[0], np.float64)
        return self._gicp.preprocess_points(points, SPACING, NEIGHBORS, 1)

    def refine(self, batch: RgbdBatch, pose: np.ndarray) -> Estimates:
        """Align each instance's points from its start pose, in threads; not valid where it has too few points. See `Estimator`."""
        begin = time.perf_counter()
        rotations, count = to_rotations(pose), len(self._instances)
        starts = np.tile(np.eye(4), (count, 1, 1))
        starts[:, :3, :3], starts[:, :3, 3] = rotations, pose[:, :3]
        with ThreadPoolExecutor(self._threads, "gicp") as pool:
            results = list(pool.map(lambda row: self._align(batch, row, starts[row]), range(count)))
        poses = np.array([matrix for matrix, _ in results]).reshape(-1, 4, 4)
        scores = np.array([score for _, score in results], np.float32)
        seconds = np.full(count, (time.perf_counter() - begin) / max(1, len(batch)), np.float32)
        return Estimates(to_transforms(poses), np.maximum(scores, 0.0), scores >= 0.0, seconds)

    def _align(self, batch: RgbdBatch, row: int, start: np.ndarray) -> tuple[np.ndarray, float]:
        """Refined pose (4, 4), and the fraction of points with a correspondence; -1: there are too few points."""
        points = observed_points(batch, int(self._instances.view[row]), int(self._instances.slot[row]))
        if len(points) < MIN_POINTS:
            return start, -1.0
        source, _ = self._gicp.preprocess_points(points, SPACING, NEIGHBORS, 1)
        target, tree = self._targets[int(self._instances.model[row])]
        # The observed part moves onto the whole model, so that every point has a partner.
        result = self._gicp.align(
            target,
            source,
            tree,
            np.linalg.inv(start),
            registration_type="GICP",
            max_correspondence_distance=MAX_DISTANCE,
            num_threads=1,
            max_iterations=ITERATIONS,
            rotation_epsilon=EPSILON,
            translation_epsilon=EPSILON,
        )
        matrix = np.linalg.inv(result.T_target_source)
        if not np.isfinite(matrix).all():
            return start, 0.0
        return matrix, result.num_inliers / max(1, source.size())

    def estimate(self, batch: RgbdBatch) -> Estimates:
        """Not implemented (NotImplementedError): GICP needs a start pose."""
        raise NotImplementedError

    def start(self, pose: np.ndarray, rows: np.ndarray) -> None:
        """Not implemented (NotImplementedError): GICP does not track."""
        raise NotImplementedError

    def track(self, batch: RgbdBatch) -> Estimates:
        """Not implemented (NotImplementedError): GICP does not track."""
        raise NotImplementedError


def observed_points(batch: RgbdBatch, view: int, slot: int) -> np.ndarray:
    """Depth pixels of an instance's mask as points in the camera's axes (P, 3) float64 [m]."""
    rows, columns = np.nonzero((batch.label[view] == 1 + slot) & (batch.depth[view] > 0))
    z = batch.depth[view][rows, columns] * np.float64(batch.depth_scale[view])
    fx, fy, cx, cy = batch.intrinsics[view].astype(np.float64).tolist()
    return np.stack(((columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z), axis=-1)
