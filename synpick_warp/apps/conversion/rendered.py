"""Masks of views without any: silhouettes of models at their poses, re-rendered as `validate` does."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.apps.validation.comparison import MEASURED_DEPTH
from synpick_warp.apps.validation.rendering import ObjectRenderer
from synpick_warp.configs.calibration.lens import read_lens
from synpick_warp.dataset.bop.layout import Layout
from synpick_warp.dataset.view_files import SceneFiles
from synpick_warp.errors import DatasetError

REMARK = (
    "Masks are rendered from models and poses, since the source has none: visible is where no annotated object and, by more than"
    f" {MEASURED_DEPTH:.0f} mm, no measured depth is nearer."
)


@cache
def _renderer(root: Path) -> ObjectRenderer:
    """Renderer of a data set's models, one a process."""
    return ObjectRenderer(Layout(root))


def render_masks(
    root: Path, files: SceneFiles, frame: int, camera: dict[str, Any], gt: list[dict[str, Any]]
) -> list[tuple[np.ndarray, ...]]:
    """Render the amodal and visible mask (H, W) bool of each instance of a view.

    Args:
        root: Folder of the data set, which has the models.
        files: Files of the scene.
        frame: BOP im_id.
        camera: Entry in scene_camera.json.
        gt: Entries in scene_gt.json.

    Raises:
        DatasetError: An object has no model, or the image no intrinsics.
        CatalogError: A model cannot be read.
    """
    if "cam_K" not in camera:
        raise DatasetError(f"{files.place}: the camera of image {frame} has no cam_K, by which masks are rendered")
    size = files.image_size(frame)
    matrix, lens = np.reshape(np.asarray(camera["cam_K"], np.float64), (3, 3)), read_lens(camera, size)
    measured, nearest = None, np.full(size[::-1], np.inf, np.float32)
    if files.has("depth") and "depth_scale" in camera:
        measured = files.typed_image("depth", frame, None, "uint16") * np.float32(camera["depth_scale"])
    found = []
    for truth in gt:
        rotation, translation = (np.asarray(truth[name], np.float64) for name in ("cam_R_m2c", "cam_t_m2c"))
        patch = _renderer(root).render(int(truth["obj_id"]), rotation.reshape(3, 3), translation.reshape(3), matrix, size, lens)
        window = np.s_[patch.top : patch.top + patch.depth.shape[0], patch.left : patch.left + patch.depth.shape[1]]
        nearest[window] = np.minimum(nearest[window], patch.depth)
        found.append((patch.depth, window))
    return [_make_masks(depth, window, nearest, measured) for depth, window in found]


def _make_masks(depth: np.ndarray, window: Any, nearest: np.ndarray, measured: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Amodal and visible mask (H, W) bool of an object by its depth in a window, the nearest of all, and that of the image (None: none)."""
    amodal, visible = np.zeros((2, *nearest.shape), bool)
    amodal[window] = np.isfinite(depth)
    visible[window] = amodal[window] & (depth <= nearest[window])
    if measured is not None:
        visible[window] &= (measured[window] == 0) | (measured[window] >= depth - np.float32(MEASURED_DEPTH))
    return amodal, visible
