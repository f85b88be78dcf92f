"""Models folders as subjects of rules: PLY headers, geometry, and entries of models_info.json."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from synpick_warp.apps.validation.schemas import convert
from synpick_warp.dataset.annotations import ModelInfo
from synpick_warp.dataset.bop.layout import MODEL_FILE, Listing
from synpick_warp.errors import CatalogError, DatasetError
from synpick_warp.scenes.assets.asset_files import MAX_MESH_FILE
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.assets.models_info import MAX_INFO
from synpick_warp.scenes.assets.ply import MAX_HEADER, read_ply_vertices
from synpick_warp.scenes.types import TriangleMesh
from synpick_warp.system.inputs.json import decode_json
from synpick_warp.system.random_numbers import sample_triangles

_CHUNK = 512
"""Points whose distances to all others are computed at a time."""
_MILLIMETRE = 1e-3


@dataclass(frozen=True, eq=False)
class ModelsFolder:
    """Folder of models, such as models, models_eval or models_cad, with its models_info.json."""

    listing: Listing

    @property
    def place(self) -> str:
        """Path relative to the data set."""
        return self.listing.place

    @cached_property
    def files(self) -> dict[int, str]:
        """Names of the PLY files by obj_id."""
        return {int(match[1]): match[0] for name in sorted(self.listing.files) if (match := MODEL_FILE.fullmatch(name))}

    @cached_property
    def info(self) -> tuple[dict[str, Any], str]:
        """(entries of models_info.json, not checked; fault of the file, empty: none)."""
        if "models_info.json" not in self.listing.files:
            return {}, ""
        try:
            data = self.listing.read("models_info.json", MAX_INFO)
            return decode_json(data, dict[str, Any], self.listing.name("models_info.json"), DatasetError), ""
        except DatasetError as error:
            return {}, str(error)


@dataclass(frozen=True, eq=False)
class ModelSubject:
    """Subject of rules about a model: its mesh, and its entry in models_info.json."""

    folder: ModelsFolder
    obj_id: int

    @property
    def place(self) -> str:
        """Path of the PLY file relative to the data set."""
        return self.folder.listing.name(self.folder.files[self.obj_id])

    @property
    def info_file(self) -> str:
        """Path of models_info.json relative to the data set."""
        return self.folder.listing.name("models_info.json")

    @cached_property
    def entry(self) -> tuple[ModelInfo | None, str]:
        """(entry of models_info.json, fault): None and the reason if it is missing or damaged; None and no reason without that file."""
        found = self.folder.info[0].get(str(self.obj_id))
        if found is None:
            return None, "no entry" if self.folder.info[0] else ""
        try:
            return convert(found, ModelInfo), ""
        except ValueError as fault:
            return None, str(fault)

    @cached_property
    def header(self) -> list[str]:
        """Lines of the PLY file's header."""
        data = self.folder.listing.read(self.folder.files[self.obj_id], MAX_MESH_FILE)[:MAX_HEADER]
        head, _, _ = data.partition(b"end_header")
        return [line.strip() for line in head.decode("utf-8", "replace").splitlines()]

    @cached_property
    def mesh(self) -> tuple[TriangleMesh | None, str]:
        """(triangle mesh [m], fault): None and the reason if it cannot be read, else the mesh and an empty text."""
        try:
            return read_mesh(self.folder.listing.path(self.folder.files[self.obj_id]), _MILLIMETRE)[0], ""
        except CatalogError as error:
            return None, str(error)

    @cached_property
    def vertices(self) -> np.ndarray | None:
        """Vertices of the file (V, 3) float64 [mm]; None: they cannot be read."""
        try:
            return read_ply_vertices(self.folder.listing.path(self.folder.files[self.obj_id]))
        except CatalogError:
            return None


def diameter(points: np.ndarray) -> float:
    """Largest distance between two points (V, 3): between two corners of the convex hull."""
    points = np.unique(points, axis=0)
    if len(points) > _CHUNK:
        try:
            points = points[ConvexHull(points).vertices]
        except QhullError:  # Points in a plane.
            points = points[:: max(1, len(points) // (8 * _CHUNK))]
    squared = (points**2).sum(axis=1)
    parts = (points[start : start + _CHUNK] for start in range(0, len(points), _CHUNK))
    largest = max(float(((part**2).sum(axis=1)[:, None] + squared - 2.0 * part @ points.T).max()) for part in parts)
    return float(np.sqrt(max(largest, 0.0)))


def sample_area(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Sample points of a surface (N, 3), evenly by area; see `sample_triangles`."""
    corners = vertices[faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face, weights = sample_triangles(area, count)
    return np.einsum("sk,skc->sc", weights, corners[face])
