"""Comparison of a view with its instances, which the bake's rasterizer renders again, each in one window of the image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from msgspec import UNSET

from synpick_warp.apps.validation.scene_files import StoredMask, crop_mask
from synpick_warp.apps.validation.subjects import ViewSubject
from synpick_warp.configs.calibration.lens import LensMap, read_lens
from synpick_warp.dataset.bop.layout import Layout
from synpick_warp.errors import CatalogError, ConfigError, DatasetError, SynpickError
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.types import Camera, TriangleMesh
from synpick_warp.stages.render.raster import object_scene, render_object
from synpick_warp.stages.render.scene import build_meshes
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
        """Whether an object has a renderable model; the rules about models report those that have none."""
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


if TYPE_CHECKING:
    from synpick_warp.apps.validation.comparison import DepthPatch, ObjectRenderer
    from synpick_warp.apps.validation.registry import Tolerance

EXACT_DEPTH, MEASURED_DEPTH = 1.0, 15.0
"""Largest difference of depth from the model [mm]: of rendered depth, and of a sensor's (BOP's tolerance of visibility)."""
MIN_PIXELS = 40
"""Smallest silhouette or mask that is compared [px]: smaller ones consist of their border."""
EXACT_AREA, EXACT_OUTLINE = 0.002, 0.1
"""Mask tolerance in data sets that this package baked: EXACT_AREA x area + EXACT_OUTLINE x length of the outline [px] may differ, plus a
few. A shift by 1 px exceeds it."""
AREA, OUTLINE = 0.02, 0.4
"""Mask tolerance for data sets of other origin, by the same formula. It admits the half-pixel shift of sampling at pixel corners, but no
shift by 2 px."""
MARGIN = 24
"""Search range of a mask's shift [px]."""


@dataclass(eq=False)
class Instance:
    """Instance of a view in crops (h, w) of its images at (left, top)."""

    index: int
    obj_id: int
    left: int
    top: int
    rendered: np.ndarray
    """Depth of the object alone [mm]; inf: beside its silhouette."""
    mask: np.ndarray | None
    """Amodal mask; None: the data set has none."""
    visible: np.ndarray | None
    """Visible mask."""
    depth: np.ndarray | None
    """Depth of the image [mm]; 0: unknown."""
    nearest: np.ndarray
    """Depth of the nearest of all rendered instances [mm]."""
    translation: np.ndarray
    """Of the pose (3) [mm]."""

    @property
    def silhouette(self) -> np.ndarray:
        """Rendered silhouette (bool): pixels at which the object alone has depth."""
        return np.isfinite(self.rendered)

    @cached_property
    def seen(self) -> np.ndarray:
        """Pixels with depth in both the visible mask and the silhouette."""
        if self.depth is None or self.visible is None:
            return np.zeros(self.rendered.shape, bool)
        return self.visible & self.silhouette & (self.depth > 0.0)

    def visible_part(self, tolerance: float) -> np.ndarray:
        """Silhouette where no other instance, and nothing else in the depth image, is nearer by more than a tolerance [mm]."""
        part = self.silhouette & (self.rendered <= self.nearest + np.float32(0.01))
        if self.depth is not None:
            part &= ~((self.depth > 0.0) & (self.depth < self.rendered - np.float32(tolerance)))
        return part


@dataclass(frozen=True)
class Fit:
    """Agreement of two masks; `iou` is intersection over union."""

    differing: int
    """Pixels of one only."""
    iou: float
    good: bool
    """Whether the difference is explained by their outlines, or within the tolerance."""
    distance: float
    """Mean distance of the outlines [px]: differing pixels per pixel of the longer outline."""


class ComparedView:
    """A view with its re-rendered instances: those with a model, and with a mask or silhouette that is large enough."""

    def __init__(self, view: ViewSubject, renderer: ObjectRenderer, given: Tolerance | None = None) -> None:
        self.view, self.renderer, self.place, self.given = view, renderer, view.place, given

    @property
    def tolerance(self) -> float:
        """Difference of depth up to which two depths count as equal [mm], at least one and a half counts."""
        scale = self.view.camera.depth_scale if self.view.camera is not None else UNSET
        count = scale if isinstance(scale, float | int) else 0.0
        bound = EXACT_DEPTH if self.view.scene.exact else MEASURED_DEPTH
        return max(bound if self.given is None else self.given.mm, 1.5 * count)

    @cached_property
    def matrix(self) -> np.ndarray | None:
        """Intrinsics (3, 3); None: the image has none, or another camera model."""
        camera = self.view.camera
        if camera is None or not isinstance(camera.cam_K, list) or not (camera.cam_K[0] > 0.0 and camera.cam_K[4] > 0.0):
            return None
        return np.reshape(np.array(camera.cam_K, np.float64), (3, 3))

    @cached_property
    def lens(self) -> LensMap | None:
        """Distortion of the camera; None: a pinhole, or values that no lens has."""
        camera, size = self.view.camera, self.view.size
        if self.matrix is None or camera is None or size is None or camera.cam_dist is UNSET:
            return None
        try:
            values = {"cam_K": camera.cam_K, "cam_dist": camera.cam_dist}
            return read_lens(values if camera.cam_dist_model is UNSET else values | {"cam_dist_model": camera.cam_dist_model}, size)
        except ConfigError:
            return None

    @cached_property
    def depth(self) -> np.ndarray | None:
        """Depth image (H, W) float32 [mm]; None: the view has none."""
        view = self.view
        scale = view.camera.depth_scale if view.camera is not None else UNSET
        if view.depth is None or view.depth.shape[::-1] != view.size or not isinstance(scale, float | int):
            return None
        return view.depth.astype(np.float32) * np.float32(scale)

    @cached_property
    def instances(self) -> list[Instance]:
        """Instances with rendered and stored crops, those that can be compared. Cached."""
        view, matrix = self.view, self.matrix
        if matrix is None or view.size is None:
            return []
        patches: list[tuple[int, DepthPatch]] = []
        nearest = np.full((view.size[1], view.size[0]), np.inf, np.float32)
        for index, item in enumerate(view.truths):
            rotation, translation = np.reshape(np.array(item.cam_R_m2c, np.float64), (3, 3)), np.array(item.cam_t_m2c, np.float64)
            if self.renderer.has(item.obj_id) and abs(np.linalg.det(rotation) - 1.0) < 0.01:
                patch = self.renderer.render(item.obj_id, rotation, translation, matrix, view.size, self.lens)
                patches.append((index, patch))
                nearest[patch.window] = np.minimum(nearest[patch.window], patch.depth)
        found = (self._instance(index, patch, nearest) for index, patch in patches)
        return [item for item in found if item is not None]

    def render_other(self, item: Instance, obj_id: int) -> np.ndarray:
        """Silhouette of another object at the pose of an instance, in its window (h, w)."""
        truth: Any = self.view.truths[item.index]
        result = np.zeros(item.rendered.shape, bool)
        if self.matrix is None or self.view.size is None or not self.renderer.has(obj_id):
            return result
        rotation = np.reshape(np.array(truth.cam_R_m2c, np.float64), (3, 3))
        patch = self.renderer.render(obj_id, rotation, item.translation, self.matrix, self.view.size, self.lens)
        shown = crop_mask(np.isfinite(patch.depth), "") if patch.depth.size else None
        if shown is None:
            return result
        moved_mask = replace(shown, left=shown.left + patch.left, top=shown.top + patch.top)
        return moved_mask.window(item.left, item.top, result.shape[1], result.shape[0])

    def _instance(self, index: int, patch: DepthPatch, nearest: np.ndarray) -> Instance | None:
        """Cut an instance's window; None: too few pixels, or nothing to compare them with."""
        masks = [self._mask(kind, index) for kind in ("mask", "mask_visib")]
        present = [mask for mask in masks if mask is not None]
        rows, columns = patch.depth.shape
        boxes = [mask.box for mask in present if mask.box is not None] + (
            [(patch.left, patch.top, columns, rows)] if patch.depth.size else []
        )
        if not boxes or not present:
            return None
        left, top = min(box[0] for box in boxes), min(box[1] for box in boxes)
        width, height = max(box[0] + box[2] for box in boxes) - left, max(box[1] + box[3] for box in boxes) - top
        rendered = np.full((height, width), np.inf, np.float32)
        rendered[patch.top - top : patch.top - top + rows, patch.left - left : patch.left - left + columns] = patch.depth
        window = slice(top, top + height), slice(left, left + width)
        mask, visible = (None if found is None else found.window(left, top, width, height) for found in masks)
        largest = max(np.count_nonzero(part) for part in (mask, visible) if part is not None)
        if max(largest, np.count_nonzero(np.isfinite(rendered))) < MIN_PIXELS:
            return None
        item: Any = self.view.truths[index]
        depth = None if self.depth is None else self.depth[window]
        return Instance(index, item.obj_id, left, top, rendered, mask, visible, depth, nearest[window], np.array(item.cam_t_m2c))

    def _mask(self, kind: str, index: int) -> StoredMask | None:
        """Mask of an instance; None: it is missing, or of another size than the image."""
        masks = self.view.masks.get(kind)
        found = None if masks is None else masks[index]
        return found if found is not None and found.size == self.view.size else None


def fit_masks(one: np.ndarray, other: np.ndarray, *, exact: bool = False, within: float | None = None) -> Fit:
    """Compare two masks (h, w); `exact`: by the bounds for our data sets; `within`: by the mean distance of the outlines [px] instead."""
    differing = int(np.count_nonzero(one ^ other))
    union = int(np.count_nonzero(one | other))
    outline = max(_outline(one), _outline(other))
    area, line = (EXACT_AREA, EXACT_OUTLINE) if exact else (AREA, OUTLINE)
    distance = differing / max(outline, 1)
    good = differing <= area * union + line * outline + 4 if within is None else distance <= within
    return Fit(differing, 1.0 - differing / max(union, 1), good, distance)


def _outline(mask: np.ndarray) -> int:
    """Number of pixels of a mask with a neighbour outside of it, or at the border of the window."""
    padded = np.pad(mask, 1)
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return int(np.count_nonzero(mask & ~inner))


def best_shift(mask: np.ndarray, silhouette: np.ndarray) -> tuple[int, int]:
    """Columns and rows by which a mask (h, w) is shifted from a silhouette: where their overlap is largest (cross-correlation by FFT)."""
    from scipy.signal import fftconvolve  # which takes half a second to import

    overlap = fftconvolve(mask.astype(np.float32), silhouette[::-1, ::-1].astype(np.float32), mode="full")
    height, width = mask.shape
    rows, columns = (slice(max(0, size - 1 - MARGIN), size + MARGIN) for size in mask.shape)
    part = np.rint(overlap[rows, columns])
    # Of equal overlaps the smallest shift.
    down, right = np.nonzero(part == part.max())
    down, right = down + rows.start - (height - 1), right + columns.start - (width - 1)
    nearest = int(np.argmin(down**2 + right**2))
    return int(right[nearest]), int(down[nearest])


def moved(image: np.ndarray, columns: int, rows: int, fill: float = 0.0) -> np.ndarray:
    """Image shifted right by `columns` and down by `rows`; pixels that leave the window are lost, `fill` is where none have moved to."""
    height, width = image.shape
    result = np.full_like(image, fill)
    target = slice(max(0, rows), min(height, height + rows)), slice(max(0, columns), min(width, width + columns))
    source = slice(max(0, -rows), min(height, height - rows)), slice(max(0, -columns), min(width, width - columns))
    result[target] = image[source]
    return result
