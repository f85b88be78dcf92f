"""Depth of single objects, re-rendered by the bake's rasterizer from a data set's models, poses and intrinsics, cropped to the object."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.configs.calibration.lens import LensMap
from synpick_warp.dataset.bop.layout import Layout
from synpick_warp.errors import CatalogError, DatasetError, SynpickError
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.types import Camera, TriangleMesh
from synpick_warp.stages.render.scene import build_meshes
from synpick_warp.stages.render.single_object import object_scene, render_object
from synpick_warp.system.hardware.device import pick_device, start_warp

_MILLIMETRE = 1e-3
_FAR = 1e20
"""Larger depths are misses [m]: the rasterizer's are `FAR`."""
_NEAR = 1e-3
"""Near plane of the crop [m]: nothing is cropped if a point is nearer, and nothing is rendered if all are."""
MAX_MODELS = 64
"""Models that are kept in memory; the least recently used one is dropped."""


@dataclass(frozen=True, eq=False)
class DepthPatch:
    """Depth of one object in a crop of the image."""

    left: int
    top: int
    depth: np.ndarray
    """Planar depth (h, w) float32 [mm]; inf: the object is not there."""

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the crop in the image."""
        return np.s_[self.top : self.top + self.depth.shape[0], self.left : self.left + self.depth.shape[1]]


class ObjectRenderer:
    """Renders objects of a data set one by one, on the CPU."""

    def __init__(self, layout: Layout) -> None:
        start_warp()
        self.layout = layout
        self.device = pick_device("cpu")
        self._load = lru_cache(MAX_MODELS)(self._read)
        self._damaged: set[int] = set()

    def render(
        self,
        obj_id: int,
        rotation: np.ndarray,
        translation: np.ndarray,
        matrix: np.ndarray,
        size: tuple[int, int],
        lens: LensMap | None = None,
    ) -> DepthPatch:
        """Render an object by its pose to the camera, rotation (3, 3) and translation (3) [mm].

        `matrix` (3, 3) [px] has the intrinsics, where the centre of pixel (row, column) is (column + 0.5, row + 0.5); `size` is width and
        height of the image [px]; `lens`: distortion, None: a pinhole. Raises CatalogError if the model cannot be read, or has too many
        triangles, and DatasetError if there is none.
        """
        mesh, meshes, keep = self._load(obj_id)
        points = mesh.vertices.astype(np.float64) @ rotation.T + translation * _MILLIMETRE
        left, top, right, bottom = _crop(points, matrix, size, lens)
        if left >= right or top >= bottom:
            return DepthPatch(0, 0, np.full((0, 0), np.inf, np.float32))
        shifted = matrix - np.array([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
        bent = None if lens is None else lens.cropped(left, top, (right - left, bottom - top))
        camera = Camera(right - left, bottom - top, shifted, rotation, translation * _MILLIMETRE, lens=bent)
        depth = render_object(object_scene(meshes, keep, (camera,), self.device), 0).depth.numpy()[0]
        depth = depth[: bottom - top, : right - left].astype(np.float32)
        return DepthPatch(left, top, np.where(depth < _FAR, depth / np.float32(_MILLIMETRE), np.float32(np.inf)))

    def has(self, obj_id: int) -> bool:
        """Whether an object has a model that can be rendered; others are left to the rules about models."""
        if obj_id not in self._damaged:
            try:
                self._load(obj_id)
            except SynpickError:
                self._damaged.add(obj_id)
        return obj_id not in self._damaged

    def _read(self, obj_id: int) -> tuple[TriangleMesh, Any, tuple[wp.Mesh, ...]]:
        """Read a model; raises DatasetError if there is none, and CatalogError if it cannot be read, or has no triangles."""
        if obj_id not in self.layout.model_files:
            raise DatasetError(f"there is no model of obj_id {obj_id}")
        folder, name = self.layout.model_files[obj_id]
        mesh = read_mesh(self.layout.models[folder].path(name), _MILLIMETRE)[0]
        if not len(mesh.faces):
            raise CatalogError(f"{folder}/{name}: no triangles")
        return mesh, *build_meshes([mesh], 1, self.device)


def _crop(points: np.ndarray, matrix: np.ndarray, size: tuple[int, int], lens: LensMap | None) -> tuple[int, int, int, int]:
    """Part of the image that shows points (V, 3) [m], with a pixel around it: left, top, right, bottom; the last two exclusive."""
    width, height = size
    if points[:, 2].max() <= _NEAR:
        return 0, 0, 0, 0
    if points[:, 2].min() <= _NEAR:
        return 0, 0, width, height
    x = matrix[0, 0] * points[:, 0] / points[:, 2] + matrix[0, 2]
    y = matrix[1, 1] * points[:, 1] / points[:, 2] + matrix[1, 2]
    margin = 1.0
    if lens is not None:
        slopes = points[:, :2] / points[:, 2:]
        x, y = lens.project(slopes).T
        margin += lens.bend * (np.ptp(slopes, axis=0) ** 2).sum() / 6
    low = np.clip(np.floor([x.min(), y.min()]) - margin, 0, size)
    high = np.clip(np.ceil([x.max(), y.max()]) + margin, 0, size)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
