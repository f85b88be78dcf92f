"""Object models, pose errors ADD, ADD-S, rotation and translation error over many pairs of poses, as the BOP toolkit defines them, and the
area under their accuracy-threshold curve (AUC).

A pair is an estimated and a true pose of one object, rotations (P, 3, 3) and translations (P, 3) [m] from object to camera, in float64. ADD
and ADD-S are those of Hinterstoisser et al. (ACCV 2012); ADD-S is called ADI there. Distances are in metres, angles in degrees.

Areas are of errors with one entry per true instance [m]; infinity stands for a missing detection, which counts as a miss. Two conventions
are in use, and they differ for few instances:

- exact: the area under the step function, mean of max(0, 1 - e / limit), as in the code of ICG and FoundationPose.
- vocap: PoseCNN's, from the YCB-Video toolbox, also CosyPose's: the curve between two errors has the accuracy of the larger one, so n
  instances score up to 1 / n more.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from synpick_warp.dataset.bop.models import find_models
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
        """Mean distance (P,) [m] from the vertices, moved by each pose (P, 3, 3), (P, 3) [m], to the nearest vertex of the model in its own
        frame (ADD-S)."""
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
    """Read models of a data set, thinned to a number of vertices (0: all), evenly in the order of the file, as models have them in no order
    of importance. Raises DatasetError if the data set has no models, or an object has none, and CatalogError if a file of the models is
    damaged."""
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
    """Exact area to `limit` [m] under the accuracy-threshold curve of errors (N,) [m], infinity: missed; from 0 to 1, NaN without
    errors."""
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
    """Number of instances."""
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
