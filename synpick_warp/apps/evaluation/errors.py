"""Object models, pose errors ADD, ADD-S, rotation and translation error over many pairs of poses, as the BOP toolkit defines them, and the
area under their accuracy-threshold curve (AUC).

A pair is an estimated and a true pose of one object, rotations (P, 3, 3) and translations (P, 3) [m] from object to camera, in float64. ADD
and ADD-S are those of Hinterstoisser et al. (ACCV 2012); ADD-S is called ADI there. Distances are in metres, angles in degrees.

Areas are of errors with one entry per true instance [m]; infinity stands for a missing detection, which counts as a miss. Two conventions
are in use, and they differ for few instances:

- exact: the area under the step function, mean of max(0, 1 - e / limit), as in the code of ICG and FoundationPose.
- vocap: PoseCNN's, from the YCB-Video toolbox, also CosyPose's: the curve between two errors has the accuracy of the larger one, so n
  instances score up to 1 / n more.

Errors are those of the matched estimate of every true instance. Each of ADD, ADD-S and ADD(-S) is matched by itself, as the BOP toolkit
matches each error function; rotation and translation errors are those of the match by ADD(-S). Matching is greedy by descending score, as
the toolkit's `pose_matching.match_poses`, per image and object: an estimate takes, of the instances that are left, the one with the
smallest error, if that is below the threshold. A round matches the best remaining estimate of each image and object.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.truth import PoseTable, Truth
from synpick_warp.dataset.bop.layout import find_models
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.models_info import FileModelInfo
from synpick_warp.scenes.assets.ply import read_ply_vertices

_CHUNK = 2**15
"""Points that are transformed at once: what the cache holds; four times as fast as many more."""
LEAF_SIZE = 32
"""Vertices in a leaf of the k-d tree: a sixth faster than SciPy's 10 on models of 1,000 vertices."""
NEAR = 1.01
"""Distance that counts as a model's radius, relative to it: the matrices of result files may be off by 0.001."""
_QUERIED = 2**20
"""Points that the k-d tree is asked for at once; some 50 MB."""


class VertexSearch:
    """Distances to the nearest vertices of a model."""

    def __init__(self, vertices: np.ndarray) -> None:
        """Prepare a search among vertices (V, 3) [m]."""
        self._vertices = vertices
        self._tree = KDTree(vertices, leafsize=LEAF_SIZE)
        self.center = vertices.mean(axis=0)
        """Centroid of the vertices (3,) [m]."""
        self.radius = float(np.linalg.norm(vertices - self.center, axis=1).max())
        """Largest distance of a vertex from the centroid [m]."""

    def mean_distances(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Mean distance (P,) [m] of vertices moved by poses (P, 3, 3), (P, 3) [m] to the nearest vertex in the model's own frame
        (ADD-S)."""
        result = np.empty(len(rotation))
        for rows in chunks(len(rotation), len(self._vertices), _QUERIED):
            points = self._vertices @ rotation[rows].transpose(0, 2, 1) + translation[rows, None]
            result[rows] = self._tree.query(points.reshape(-1, 3), workers=-1)[0].reshape(points.shape[:2]).mean(axis=1)
        return result


def chunks(pairs: int, vertices: int, points: int) -> Iterator[slice]:
    """Slices of pairs, each with at most `points` points or of a single pair."""
    step = max(1, points // max(vertices, 1))
    for start in range(0, pairs, step):
        yield slice(start, start + step)


def add_errors(
    estimated_rotation: np.ndarray,
    estimated_translation: np.ndarray,
    true_rotation: np.ndarray,
    true_translation: np.ndarray,
    vertices: np.ndarray,
) -> np.ndarray:
    """ADD: mean distance (P,) [m] between corresponding vertices; `vertices` (V, 3) [m] are those of the model."""
    errors = np.empty(len(estimated_rotation))
    # R_e x + t_e - (R_g x + t_g) is affine in x.
    rotation, translation = estimated_rotation - true_rotation, estimated_translation - true_translation
    count, columns = len(vertices), np.ascontiguousarray(vertices.T)
    for rows in chunks(len(errors), count, _CHUNK):
        offsets = (rotation[rows].reshape(-1, 3) @ columns).reshape(-1, 3, count)
        offsets += translation[rows, :, None]
        offsets *= offsets
        errors[rows] = np.sqrt(offsets.sum(axis=1)).mean(axis=1)
    return errors


def adds_errors(
    estimated_rotation: np.ndarray,
    estimated_translation: np.ndarray,
    true_rotation: np.ndarray,
    true_translation: np.ndarray,
    vertices: np.ndarray,
    search: VertexSearch | None = None,
) -> np.ndarray:
    """ADD-S (ADI): mean distance (P,) [m] from a vertex in the true pose to the nearest vertex in the estimated pose, whose matrix is
    orthonormal.

    Nearest neighbours are searched in the object's axes, so that one search structure serves all pairs; None: it is built.
    """
    inverse = np.linalg.inv(estimated_rotation)
    translation = np.einsum("pij,pj->pi", inverse, true_translation - estimated_translation)
    return (VertexSearch(vertices) if search is None else search).mean_distances(inverse @ true_rotation, translation)


def translation_errors(estimated_translation: np.ndarray, true_translation: np.ndarray) -> np.ndarray:
    """Distance between the origins of the object (P,) [m]."""
    return np.linalg.norm(estimated_translation - true_translation, axis=1)


def rotation_errors(estimated_rotation: np.ndarray, true_rotation: np.ndarray, symmetries: np.ndarray | None = None) -> np.ndarray:
    """Angle (P,) from 0 to 180 [°] of the rotation between the poses, the smallest over the rotations (S, 3, 3) under which the object
    looks the same, the identity among them; None: the identity alone."""
    relative = estimated_rotation.transpose(0, 2, 1) @ true_rotation
    if symmetries is not None and len(symmetries) > 1:
        # trace(A S) is a scalar product of Aᵀ and S; the largest one has the smallest angle.
        traces = relative.transpose(0, 2, 1).reshape(-1, 9) @ symmetries.reshape(-1, 9).T
        relative = relative @ symmetries[np.argmax(traces, axis=1)]
    # atan2 of sine and cosine, since arccos loses half of the digits at 0° and 180°.
    skew = 0.5 * (relative - relative.transpose(0, 2, 1))
    sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1), axis=1)
    cosine = 0.5 * (np.trace(relative, axis1=1, axis2=2) - 1.0)
    return np.degrees(np.arctan2(sine, cosine))


_METERS = 1e-3
"""In a millimetre."""
_MAX_STEP = 0.01
"""Step of continuous symmetries as a fraction of the diameter: the BOP toolkit's max_sym_disc_step."""


@dataclass(frozen=True, eq=False)
class Model:
    """Object model for evaluation."""

    object_id: int
    vertices: np.ndarray
    """(V, 3) float64 [m]."""
    symmetries: np.ndarray
    """Rotations (S, 3, 3) float64 under which the object looks the same, continuous ones in steps; the first is the identity."""
    symmetric: bool
    """Whether models_info.json lists a symmetry: then ADD(-S) is ADD-S, else ADD."""

    @cached_property
    def search(self) -> VertexSearch:
        """Nearest-vertex search over the model's vertices, built on first use."""
        return VertexSearch(self.vertices)

    def thinned(self, count: int) -> "Model":
        """Model with at most `count` vertices, taken evenly in their order; 0: all."""
        if not 0 < count < len(self.vertices):
            return self
        rows = np.linspace(0, len(self.vertices) - 1, count).round().astype(np.int64)
        return replace(self, vertices=self.vertices[rows])


def read_models(folder: Path, object_ids: Iterable[int], vertices: int = 0) -> dict[int, Model]:
    """Read models of a data set, thinned to a number of vertices (0: all), evenly in the order of the file. Raises DatasetError if the data
    set has no models, or an object has none, and CatalogError if a file of the models is damaged."""
    found = find_models(folder, object_ids, "poses are evaluated")
    return {object_id: _read_model(*pair, object_id, vertices) for object_id, pair in found.items()}


def _read_model(path: Path, info: FileModelInfo, object_id: int, count: int) -> Model:
    """Read a model, from mm to m, thinned to at most `count` vertices (0: all); raises CatalogError if a vertex lies absurdly far out."""
    points = _METERS * read_ply_vertices(path)
    if np.abs(points).max() > 1e6:
        raise CatalogError(f"{path}: a vertex is more than 1e9 mm from the origin; repair the mesh")
    symmetric = bool(info.symmetries_discrete or info.symmetries_continuous)
    return Model(object_id, points, expand_symmetries(info), symmetric).thinned(count)


def expand_symmetries(info: FileModelInfo) -> np.ndarray:
    """Rotations of all symmetries (S, 3, 3), as the BOP toolkit combines them: continuous ones in steps, after each discrete one."""
    discrete = np.stack([np.eye(3), *(np.reshape(matrix, (4, 4))[:3, :3] for matrix in info.symmetries_discrete)])
    if not info.symmetries_continuous:
        return discrete
    steps = int(np.ceil(np.pi / _MAX_STEP))
    angles = 2.0 * np.pi / steps * np.arange(steps)
    turns = np.concatenate([Rotation.from_rotvec(angles[:, None] * np.asarray(axis)).as_matrix() for axis, _ in info.symmetries_continuous])
    return (turns[None] @ discrete[:, None]).reshape(-1, 3, 3)


LIMIT = 0.1
"""Largest threshold of the area [m]."""


def exact_auc(errors: np.ndarray, limit: float = LIMIT) -> float:
    """Area under the accuracy-threshold curve (AUC) up to `limit` [m], 0 to 1. `errors` (N,) [m]: infinite if missed; NaN if N is 0."""
    return float(np.maximum(0.0, 1.0 - errors / limit).mean()) if len(errors) else float("nan")


def vocap_auc(errors: np.ndarray, limit: float = LIMIT) -> float:
    """Area by PoseCNN's VOCap, from 0 to 1; NaN without errors. If every instance is missed it is 0, where PoseCNN's code has NaN.

    Arguments as `exact_auc`.
    """
    if not len(errors):
        return float("nan")
    found = np.sort(errors[errors <= limit])
    if not len(found):
        return 0.0
    # Of equal errors the original takes the accuracy of the first one for the step up to them.
    accuracy = np.arange(1, len(found) + 1) / len(errors)
    recall = np.concatenate(([0.0], found, [limit]))
    precision = np.concatenate(([0.0], accuracy, [accuracy[-1]]))
    steps = np.flatnonzero(recall[1:] != recall[:-1]) + 1
    return float(((recall[steps] - recall[steps - 1]) * precision[steps]).sum() / limit)


CONVENTIONS: dict[str, Callable[[np.ndarray], float]] = {"exact": exact_auc, "vocap": vocap_auc}
"""Convention -> area to LIMIT."""


def recall_curve(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Recall (accuracy): fraction of the instances with an error (N,) [m] below each threshold (T,) [m]; NaN without errors."""
    if not len(errors):
        return np.full(len(thresholds), np.nan)
    return np.searchsorted(np.sort(errors), thresholds, side="left") / len(errors)


@dataclass(frozen=True)
class Band:
    """Scores of the instances whose quantity, such as visibility or speed, lies in [low, high)."""

    low: float
    high: float
    """The interval includes `low`, and `high` only in the last band."""
    count: int
    auc: float
    """Exact area, from 0 to 1; NaN without instances."""
    recall: float
    """Fraction with an error below LIMIT; NaN without instances."""
    median: float
    """Median error of those [m]; NaN if there is none."""


def band_indices(values: np.ndarray, edges: Sequence[float]) -> np.ndarray:
    """Index of the band (N,) int64 of each value (N,), by the rising limits of the bands; a value at the last limit belongs to the last
    band, and -1 is outside of all bands, or NaN."""
    limits = np.asarray(edges, np.float64)
    index = np.searchsorted(limits, values, side="right") - 1
    index[values == limits[-1]] = len(limits) - 2
    index[(index >= len(limits) - 1) | np.isnan(values)] = -1
    return index


def error_bands(errors: np.ndarray, values: np.ndarray, edges: Sequence[float]) -> list[Band]:
    """Errors (N,) [m], infinity: missed, against a quantity (N,), such as visible fraction or speed, in bands with rising limits."""
    index, bands = band_indices(values, edges), []
    for number, (low, high) in enumerate(pairwise(edges)):
        inside = errors[index == number]
        found = inside[inside < LIMIT]
        recall = len(found) / len(inside) if len(inside) else float("nan")
        median = float(np.median(found)) if len(found) else float("nan")
        bands.append(Band(low, high, len(inside), exact_auc(inside), recall, median))
    return bands


METRICS = ("ADD", "ADD-S", "ADD(-S)")
"""ADD(-S) is ADD-S for objects with symmetries in models_info.json, ADD for others."""
MIN_VISIBILITY = 0.1
"""Smallest visible fraction of a target, as in BOP."""
PER_INSTANCE = -1
"""Of an image and object with n targets, the n best estimates count: n_top = -1 of the BOP toolkit's localization task."""
ALL = 0
"""All estimates count: n_top = 0."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Errors of one method for the T true instances that are visible enough."""

    name: str
    target: np.ndarray
    """Row of the ground truth (T,) int64."""
    errors: dict[str, np.ndarray]
    """Metric -> (T,) [m]; infinity: missed."""
    rotation: np.ndarray
    """Rotation error, the smallest over the object's symmetries (T,) [°]; NaN: missed by ADD(-S)."""
    translation: np.ndarray
    """Translation error (T,) [m]; NaN: missed by ADD(-S)."""
    seconds: float
    """Mean time per image [s]; NaN: unknown."""


def score(
    name: str,
    truth: Truth,
    estimates: PoseTable,
    models: Mapping[int, Model],
    min_visibility: float = MIN_VISIBILITY,
    top: int = PER_INSTANCE,
) -> Scores:
    """Score estimated poses of any scenes of a data set by the models of all objects of its ground truth; images without estimates count as
    misses, and instances below `min_visibility` are neither found nor missed. `top`: as of `make_pairs`."""
    target = truth.shown(min_visibility)
    pairs = make_pairs(truth.poses, target, estimates, top)
    pair_errors = _pair_errors(truth.poses, estimates, pairs, models)
    matches = {metric: match(pairs, pair_errors[metric], LIMIT, len(truth)) for metric in METRICS}
    rows = np.flatnonzero(target)
    errors = {}
    for metric, found in matches.items():
        errors[metric] = np.full(len(rows), np.inf)
        hit = found[rows] >= 0
        errors[metric][hit] = pair_errors[metric][found[rows][hit]]
    rotation, translation = _motion_errors(truth.poses, estimates, pairs, matches["ADD(-S)"][rows], models)
    return Scores(name, rows, errors, rotation, translation, mean_seconds(estimates))


def _pair_errors(truth: PoseTable, estimates: PoseTable, pairs: "Pairs", models: Mapping[int, Model]) -> dict[str, np.ndarray]:
    """Metric -> error of each pair (P,) [m]; infinity where a bound shows that it is above LIMIT, so that no match could have it."""
    errors = {metric: np.full(len(pairs.estimate), np.inf) for metric in METRICS}
    object_ids = truth.object_id[pairs.truth]
    for object_id in np.unique(object_ids):
        model = models[int(object_id)]
        rows = np.flatnonzero(object_ids == object_id)
        ours, theirs = truth.select(pairs.truth[rows]), estimates.select(pairs.estimate[rows])
        offset = (theirs.rotation - ours.rotation) @ model.search.center + theirs.translation - ours.translation
        distance = np.linalg.norm(offset, axis=1)
        # A mean of lengths is at least the length of the mean; a nearest vertex is not nearer than the bounding sphere.
        near = np.flatnonzero(distance < LIMIT)
        errors["ADD"][rows[near]] = add_errors(*_poses(theirs, near), *_poses(ours, near), model.vertices)
        near = np.flatnonzero(distance < LIMIT + NEAR * model.search.radius)
        errors["ADD-S"][rows[near]] = adds_errors(*_poses(theirs, near), *_poses(ours, near), model.vertices, model.search)
        errors["ADD(-S)"][rows] = errors["ADD-S" if model.symmetric else "ADD"][rows]
    return errors


def _poses(table: PoseTable, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) and translations (N, 3) of rows."""
    return table.rotation[rows], table.translation[rows]


def _motion_errors(
    truth: PoseTable, estimates: PoseTable, pairs: "Pairs", found: np.ndarray, models: Mapping[int, Model]
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (T,) [°] and translation (T,) [m] errors of matched pairs; NaN for index -1."""
    rotation, translation = np.full(len(found), np.nan), np.full(len(found), np.nan)
    hits = np.flatnonzero(found >= 0)
    ours, theirs = truth.select(pairs.truth[found[hits]]), estimates.select(pairs.estimate[found[hits]])
    translation[hits] = translation_errors(theirs.translation, ours.translation)
    for object_id in np.unique(ours.object_id):
        rows = np.flatnonzero(ours.object_id == object_id)
        rotation[hits[rows]] = rotation_errors(theirs.rotation[rows], ours.rotation[rows], models[int(object_id)].symmetries)
    return rotation, translation


def mean_seconds(estimates: PoseTable) -> float:
    """Mean time per image [s], over the images with a known time; NaN if there are none."""
    known = estimates.select(estimates.seconds >= 0.0)
    if not len(known):
        return float("nan")
    keys = np.stack((known.scene, known.image), axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    return float(known.seconds[first].mean())


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of an estimate and a true instance of the same image and object, by group, then by descending score, then by instance."""

    estimate: np.ndarray
    """Row of the estimate (P,) int64."""
    truth: np.ndarray
    """Row of the instance (P,) int64."""
    group: np.ndarray
    """Index of the image and object (P,) int64, rising."""


def make_pairs(truth: PoseTable, target: np.ndarray, estimates: PoseTable, top: int = PER_INSTANCE) -> Pairs:
    """Pair the best estimates with the instances of the same image and object; ties in score keep file order, as in the BOP toolkit.

    `target` (N,) bool: instances to be found; others are never paired, and estimates of an image and object without targets are dropped.
    `top`: maximum number of estimates per image and object; PER_INSTANCE: as many as targets; ALL."""
    truth_rows = np.flatnonzero(target)
    keys = [np.concatenate((getattr(truth, name)[truth_rows], getattr(estimates, name))) for name in ("scene", "image", "object_id")]
    group = _group_indices(keys)
    truth_group, estimate_group = group[: len(truth_rows)], group[len(truth_rows) :]
    truth_rows = truth_rows[np.argsort(truth_group, kind="stable")]
    counts = np.bincount(truth_group, minlength=int(group.max(initial=-1)) + 1)
    starts = np.cumsum(counts) - counts
    rows = np.lexsort((-estimates.score, estimate_group))
    rank = _ranks(estimate_group[rows])
    limit = counts[estimate_group[rows]] if top == PER_INSTANCE else np.full(len(rows), len(rows) if top == ALL else top)
    rows, rank = rows[rank < limit], rank[rank < limit]
    partners = counts[estimate_group[rows]]
    first = np.repeat(starts[estimate_group[rows]], partners)
    place = _ranks(np.repeat(np.arange(len(partners)), partners))
    return Pairs(
        np.repeat(rows, partners),
        truth_rows[first + place],
        np.repeat(estimate_group[rows], partners),
    )


def match(pairs: Pairs, errors: np.ndarray, threshold: float, instances: int) -> np.ndarray:
    """Match estimates to instances, each at most once, by errors (P,) below a threshold: index of each instance's pair (N,) int64, -1:
    missed. `instances` is the number N of rows of the true poses."""
    result = np.full(instances, -1, np.int64)
    left = np.flatnonzero(errors < threshold)
    while len(left):  # As many rounds as an image has instances of an object, since each round matches one of them.
        starts = np.flatnonzero(np.diff(pairs.group[left], prepend=-1))
        leaders = np.repeat(pairs.estimate[left[starts]], np.diff(starts, append=len(left)))
        leading = pairs.estimate[left] == leaders
        rows = left[leading]
        # By group, then by error; equal errors keep the order of the instances, as in the toolkit.
        rows = rows[np.lexsort((errors[rows], pairs.group[rows]))]
        best = rows[np.diff(pairs.group[rows], prepend=-1) != 0]
        result[pairs.truth[best]] = best
        left = left[~leading & (result[pairs.truth[left]] < 0)]
    return result


def _group_indices(keys: list[np.ndarray]) -> np.ndarray:
    """Dense index of each distinct combination of keys (N,) int64, in rising order of the keys."""
    order = np.lexsort(keys[::-1])
    new = np.zeros(len(order), bool)
    for key in keys:
        new[1:] |= np.diff(key[order]) != 0
    index = np.empty(len(order), np.int64)
    index[order] = np.cumsum(new)
    return index


def _ranks(groups: np.ndarray) -> np.ndarray:
    """Position of each entry in its run of equal values (N,)."""
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    return np.arange(len(groups)) - np.repeat(starts, np.diff(starts, append=len(groups)))
