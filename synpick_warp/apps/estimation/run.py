"""Run of a pose estimation by generalized ICP (Segal, Haehnel and Thrun, RSS 2009; small_gicp): observed points of a mask against points on
the model, scene by scene, to a table of poses, with times.

`single` sees nothing but the frame, `refine` starts from the disturbed truth, `track` from the truth in an instance's first frame and
afterwards from its own estimate, without restart (ICG's protocol). All are given the visible masks of the instances. A data set may come
from anywhere, so models and textures are read in isolated processes, as a bake reads them.
"""

import importlib
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from synpick_warp.apps.estimation.scenes import EstimationScene, ScenePlan, read_scene
from synpick_warp.apps.evaluation.results import TargetList, TargetRow, count_targets
from synpick_warp.apps.evaluation.truth import PoseTable
from synpick_warp.dataset.bop.layout import find_models
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import CatalogError, ConfigError, DatasetError
from synpick_warp.scenes.assets.asset_files import read_isolated
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.catalog import READ_LIMITS
from synpick_warp.scenes.types import Material, TriangleMesh
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.progress import Report, ignore_progress

SPACING = 0.003
"""Voxel size for downsampling both point clouds [m]: some 1,000 points on the visible side of a can."""
SAMPLES = 20_000
"""Number of points sampled on a model before downsampling: several per voxel, up to 0.1 m² of surface."""
NEIGHBORS = 10
"""Points from which small_gicp estimates a covariance: its default."""
MAX_DISTANCE = 0.03
"""Maximum correspondence distance [m]: the 2 cm offset of disturbed starts, plus what 15° add at 4 cm from the origin."""
ITERATIONS = 50
EPSILON = 1e-5
"""Convergence: change of the translation [m], and of the rotation [rad]."""
MIN_POINTS = 20
"""Minimum number of observed points for an estimate: covariances of NEIGHBORS points need more."""
DEPTH_OF_CENTER = 0.5
"""Distance of a start's centre behind the centroid of the observed points, in radii of the model: of a sphere's visible half."""
_MILLIMETRE = 1e-3
_METALLIC, _ROUGHNESS = 0.0, 0.5
"""Material of PLY models, which state none; only base colours are compared."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Textured mesh of an object whose pose is estimated."""

    object_id: int
    mesh: TriangleMesh
    """In the axes that poses refer to [m]."""
    material: Material


def read_object_models(folder: Path, object_ids: Iterable[int]) -> list[ObjectModel]:
    """Read the models of objects of a data set, ordered by obj_id; raises DatasetError if it has no models, or an object has none, and
    CatalogError if a model or its texture is missing or damaged."""
    found = find_models(folder, object_ids, "poses are estimated")
    calls, advice = [(path, _MILLIMETRE) for path, _ in found.values()], "repair or simplify the file"
    models = []
    for object_id, result in zip(found, read_isolated(read_mesh, calls, READ_LIMITS, CatalogError, advice, advice), strict=True):
        if isinstance(result, CatalogError):
            raise result
        models.append(ObjectModel(object_id, result.mesh, result.material.complete(_METALLIC, _ROUGHNESS)))
    return models


class Aligner:
    """Aligns the visible points of objects with their models."""

    def __init__(self, models: Iterable[ObjectModel]) -> None:
        """Prepare points on each model; raises ConfigError if small_gicp is not installed."""
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
        """Pose (4, 4) [m] of an object by its observed points (P, 3) in the camera's axes [m], from a start pose, and the fraction of the
        points that have a partner on the model; the start and 0 where there are too few."""
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


SINGLE, REFINE, TRACK = METHODS = ("single", "refine", "track")
SPARSE = 20
"""Default of `--every` for methods that look at one frame at a time: consecutive frames differ little."""
OFFSET = 0.02
"""Length of the displacement [m]; the direction is uniform on the sphere. Length and angle are the same for all, so that a result states
its convergence at this distance instead of a mean over easy and hard starts."""
TURN = 15.0
"""Angle of the rotation about the object's origin [°]; the axis is uniform on the sphere."""
DEPTHS = {"clean": "depth", "sensor": "depth_sensor"}
"""Choices of depth images, and the folders they are in."""


@dataclass(frozen=True)
class EstimationOptions:
    """Options of an estimation."""

    method: str
    """One of METHODS."""
    depth: str = "clean"
    """Key of DEPTHS."""
    min_visibility: float = 0.1
    seed: int = 0
    """Seed of the disturbed initial poses."""
    threads: int = field(default_factory=count_cores)


@dataclass(frozen=True, eq=False)
class EstimationRun:
    """Result of an estimation."""

    poses: PoseTable
    """Sorted by scene, image, object and instance."""
    views: int
    wall: float
    """Time of all [s]."""


class Estimate(NamedTuple):
    """Row of the pose table; the sort key first."""

    scene: int
    image: int
    object_id: int
    instance: int
    pose: np.ndarray
    """Object to camera (4, 4) float64 [m]."""
    score: float
    """Fraction of the observed points that lie on the model."""
    seconds: float
    """Time of the image [s]."""


def read_scenes(
    data_set: DataSet,
    plans: Sequence[ScenePlan],
    options: EstimationOptions,
    targets: TargetList | None = None,
    report: Report = ignore_progress,
) -> list[EstimationScene]:
    """Read the ground truth of scenes, and check that there is something to estimate; `targets`: objects that count in each image, None:
    all. Raises DatasetError if a file is missing or damaged, there is no such depth, or nothing is visible enough."""
    scenes, layer = [], DEPTHS[options.depth]
    for plan in plans:
        scene = read_scene(data_set, plan)
        if options.method == TRACK and not scene.truth.tracked:
            place = scene.files.place
            raise DatasetError(f"{place} has no instance_id in its ground truth, by which instances are tracked; use another method")
        if layer != "depth" and layer not in scene.files.layers():
            raise DatasetError(f'{scene.files.place} has no {layer}; bake with render.layers = ["{layer}"], or use --depth clean')
        objects = [None if targets is None else targets.objects[plan.scene, frame] for frame in plan.frames]
        scenes.append(ask(scene, options.method, options.min_visibility, objects))
        report("scenes", len(scenes), len(plans))
    if not any(scene.asked.any() for scene in scenes):
        raise DatasetError(f"no instance of {data_set.folder} is as visible as --visib-min {options.min_visibility:g} in these images")
    return scenes


def ask(scene: EstimationScene, method: str, min_visibility: float, objects: Sequence[frozenset[int] | None]) -> EstimationScene:
    """Select the instances whose poses a method of METHODS estimates in each frame.

    Tracks are asked in all frames from the first one on in which the instance is visible enough, as long as the image has it. Other methods
    are asked where it is visible enough, and of an object that counts: `objects` are the obj_ids of each planned frame, None: all.
    """
    truth = scene.truth
    asked = ~(truth.visibility < min_visibility) & (truth.box[:, 2] >= 0)
    if method == TRACK:
        instances, slot = np.unique(truth.instance, return_inverse=True)
        begin = np.full(len(instances), len(scene))
        np.minimum.at(begin, slot[asked], truth.row[asked])
        return replace(scene, asked=truth.row >= begin[slot])
    counts = [(known := objects[row]) is None or object_id in known for row, object_id in zip(truth.row, truth.object_id, strict=True)]
    return replace(scene, asked=asked & np.array(counts, bool))


def list_targets(scenes: Sequence[EstimationScene]) -> list[TargetRow]:
    """Target list of the instances that are asked for: scene, frame, object and number of instances."""
    rows = []
    for scene in scenes:
        frames, truth = scene.plan.frames, scene.truth
        rows += [(scene.plan.scene, frames[truth.row[at]], int(truth.object_id[at])) for at in np.flatnonzero(scene.asked)]
    return count_targets(rows)


def run_estimation(
    scenes: Sequence[EstimationScene], aligner: Aligner, options: EstimationOptions, report: Report = ignore_progress
) -> EstimationRun:
    """Estimate the poses of all instances that are asked for, in threads: a track's scene, or an image, at a time. Raises DatasetError if
    an image or mask is missing or damaged, or has another size than the data set's."""
    begin, total, views, rows = time.perf_counter(), sum(map(len, scenes)), 0, []
    jobs = [
        (scene, part)
        for scene in scenes
        for part in ([range(len(scene))] if options.method == TRACK else [[step] for step in range(len(scene))])
    ]
    with ThreadPoolExecutor(max(1, options.threads), "estimate") as pool:
        try:
            for (_, part), found in zip(jobs, pool.map(lambda job: list(_estimate(job[0], job[1], aligner, options)), jobs), strict=True):
                rows += found
                views += len(part)
                report("views", views, total)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return EstimationRun(_tabulate(sorted(rows, key=lambda row: row[:4])), total, time.perf_counter() - begin)


def _estimate(scene: EstimationScene, steps: Sequence[int], aligner: Aligner, options: EstimationOptions) -> Iterator[Estimate]:
    """Estimates in these frames of a scene, in order; tracks go on from one to the next."""
    tracks: dict[int, np.ndarray] = {}
    truth = scene.truth
    for step in steps:
        began = time.perf_counter()
        found: list[Estimate] = []
        for at in np.flatnonzero(scene.asked & (truth.row == step)).tolist():
            points = observed_points(scene, at, DEPTHS[options.depth])
            object_id, instance, frame = int(truth.object_id[at]), int(truth.instance[at]), scene.plan.frames[step]
            if options.method == SINGLE:
                pose, score = aligner.search(object_id, points)
            elif options.method == REFINE:
                start = disturb_pose(scene.poses[at], options.seed, scene.plan.scene, frame, instance)
                pose, score = aligner.refine(object_id, points, start)
            elif instance in tracks:
                pose, score = aligner.refine(object_id, points, tracks[instance])
            else:
                pose, score = scene.poses[at], 1.0
            tracks[instance] = pose
            # A hidden instance keeps its track; other methods have no estimate of it.
            if score > 0.0 or options.method == TRACK:
                found.append(Estimate(scene.plan.scene, frame, object_id, instance, pose, score, 0.0))
        seconds = time.perf_counter() - began  # BOP wants one time for all rows of an image.
        yield from (row._replace(seconds=seconds) for row in found)


def observed_points(scene: EstimationScene, at: int, layer: str) -> np.ndarray:
    """Depth pixels of the visible mask of an instance, a row of the ground truth, as points in the camera's axes (P, 3) float64 [m]; raises
    DatasetError if the image or the mask is missing or damaged, or has another size than the data set's."""
    truth, step = scene.truth, int(scene.truth.row[at])
    frame = scene.plan.frames[step]
    if truth.box[at, 2] < 0:
        return np.empty((0, 3))
    depth = scene.files.typed_image(layer, frame, None, "uint16")
    mask = scene.files.mask("mask_visib", frame, at - int(np.searchsorted(truth.row, step)))
    rows, columns = np.nonzero(mask & (depth > 0))
    z = depth[rows, columns] * np.float64(scene.depth_scale[step])
    fx, fy, cx, cy = scene.intrinsics[step].astype(np.float64).tolist()
    return np.stack(((columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z), axis=-1)


def _tabulate(rows: Sequence[Estimate]) -> PoseTable:
    integers = np.array([row[:4] for row in rows], np.int64).reshape(-1, 4)
    scene, image, object_id, instance = integers.T
    poses = np.array([row.pose for row in rows]).reshape(-1, 4, 4)
    score, seconds = (np.array([getattr(row, name) for row in rows], np.float64) for name in ("score", "seconds"))
    return PoseTable(scene, image, object_id, poses[:, :3, :3], poses[:, :3, 3], score, seconds, instance)


def disturb_pose(pose: np.ndarray, *key: int) -> np.ndarray:
    """Displace and rotate a pose (4, 4) [m], by exactly OFFSET and TURN in random directions.

    `key`: seed of the estimation, scene, frame and instance, which name the random numbers, whatever else is estimated.
    """
    move, axis = np.random.default_rng(key).normal(size=(2, 3))
    result = np.array(pose, np.float64)
    result[:3, 3] += OFFSET * move / np.linalg.norm(move)
    result[:3, :3] = Rotation.from_rotvec(np.radians(TURN) * axis / np.linalg.norm(axis)).as_matrix() @ result[:3, :3]
    return result
