"""Object models for pose errors: vertices and symmetries from a data set's models folder (PLY, models_info.json), in metres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.errors import VertexSearch
from synpick_warp.dataset.bop.models import find_models
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.models_info import FileModelInfo
from synpick_warp.scenes.assets.ply import read_ply_vertices

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

    def thinned(self, count: int) -> Model:
        """Model with at most `count` vertices, taken evenly in their order; 0: all."""
        if not 0 < count < len(self.vertices):
            return self
        rows = np.linspace(0, len(self.vertices) - 1, count).round().astype(np.int64)
        return replace(self, vertices=self.vertices[rows])


def read_models(folder: Path, object_ids: Iterable[int], vertices: int = 0) -> dict[int, Model]:
    """Read models of a data set.

    Args:
        folder: The data set.
        object_ids: Objects that are needed.
        vertices: Number of vertices that a model is thinned to, evenly in the order of the file, as models have them in no order of
            importance; 0: all.

    Raises:
        DatasetError: The data set has no models, or an object has none.
        CatalogError: A file of the models is damaged.
    """
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
