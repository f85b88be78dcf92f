"""Masks of a baked view as runs: crops of PNG files in scene folders, run lengths in shards."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from synpick_warp.dataset.view_files import SceneFiles, SceneFolder
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.view import Masks
from synpick_warp.exporters.writing.rle import Runs, find_run_boundaries
from synpick_warp.inputs.files import read_file_if_present
from synpick_warp.inputs.image_files import MAX_IMAGE_FILE
from synpick_warp.inputs.png_crop import decode_grey_crop


def read_masks(files: SceneFiles, frame: int, infos: list[dict[str, Any]], size: tuple[int, int]) -> list[Masks]:
    """Read both masks of all instances of a frame.

    Args:
        files: The scene's files, with masks.
        frame: Index of the frame.
        infos: The frame's entry of scene_gt_info.json.
        size: Width and height of the images [px].
    """
    if not isinstance(files, SceneFolder):
        both = [files.masks(name, frame, len(infos)) for name in ("mask", "mask_visib")]
        return [Masks(*(_find_runs(mask) for mask in pair)) for pair in zip(*both, strict=True)]
    return [
        Masks(
            _read_runs(files, "mask", frame, index, info["bbox_obj"], info["px_count_valid"], size),
            _read_runs(files, "mask_visib", frame, index, info["bbox_visib"], info["px_count_visib"], size),
        )
        for index, info in enumerate(infos)
    ]


def _read_runs(files: SceneFolder, name: str, frame: int, index: int, box: list[int], count: int, size: tuple[int, int]) -> Runs:
    """Read a mask within its box, or the whole of it, if the box does not hold the pixels that the annotations count."""
    width, height = size
    left, top = max(0, box[0]), max(0, box[1])
    rows, columns = slice(top, max(top, min(height, box[1] + box[3] + 1))), slice(left, max(left, min(width, box[0] + box[2] + 1)))
    if box[2] >= 0 and rows.stop > rows.start and columns.stop > columns.start:
        path = f"{files.folder}{os.sep}{name}{os.sep}{frame:06d}_{index:06d}.png"
        data = read_file_if_present(path, MAX_IMAGE_FILE, DatasetError)
        crop = None if data is None else decode_grey_crop(data, size, rows, columns)
        if crop is not None:
            runs = _find_runs(crop > 0, top, left)
            if runs.count == count:
                return runs
    return _find_runs(files.mask(name, frame, index))


def _find_runs(mask: np.ndarray, top: int = 0, left: int = 0) -> Runs:
    return find_run_boundaries(mask.astype(np.uint8), top, left).runs_of(1)
