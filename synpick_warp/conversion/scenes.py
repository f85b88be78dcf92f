"""Views of a scene that is converted, as exporters take them: files as they are, annotations as they were read, masks as runs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.view_files import SceneFiles, SceneFolder, ViewRecords, check_planes
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.rle import Masks, Runs, find_run_boundaries
from synpick_warp.inputs.files import read_file_if_present
from synpick_warp.inputs.image_files import MAX_IMAGE_FILE
from synpick_warp.inputs.png_crop import decode_grey_crop


@dataclass(frozen=True, eq=False)
class StoredSceneFiles:
    """`StoredScene` of a scene folder or of shards."""

    files: SceneFiles
    """Of which nothing has been read, so that they are small when pickled."""
    scene: int
    """BOP scene_id."""
    images: Sequence[int]
    """BOP im_id of each frame."""

    @property
    def frames(self) -> int:
        """See `StoredScene`."""
        return len(self.images)

    def views(self, frames: range) -> Iterator[StoredViewFiles]:
        """See `StoredScene`."""
        return (StoredViewFiles(self.files, self.scene, self.images[frame]) for frame in frames)


class StoredViewFiles:
    """`StoredView` of these files."""

    def __init__(self, files: SceneFiles, scene: int, frame: int) -> None:
        """
        Args:
            files: Files of the scene.
            scene: BOP scene_id.
            frame: BOP im_id.
        """
        self.files, self.scene, self.frame = files, scene, frame

    @cached_property
    def _records(self) -> ViewRecords:
        return self.files.records(self.frame)

    @property
    def camera(self) -> dict[str, Any]:
        """See `EncodedView`."""
        return self._records.camera

    @property
    def gt(self) -> list[dict[str, Any]]:
        """See `EncodedView`."""
        return self._records.gt

    @property
    def gt_info(self) -> list[dict[str, Any]]:
        """See `EncodedView`."""
        return self._records.gt_info

    @property
    def color(self) -> tuple[str, bytes]:
        """See `EncodedView`."""
        return self.files.image_file("rgb", self.frame)

    @property
    def depth(self) -> bytes:
        """See `EncodedView`."""
        return self.layer("depth")

    def layer(self, name: str) -> bytes:
        """See `StoredView`."""
        suffix, data = self.files.image_file(name, self.frame)
        if suffix != ".png":
            raise DatasetError(f"{name} of image {self.frame} in {self.files.place} is a {suffix} file, expected: .png; {ADVICE}")
        return data

    def color_image(self) -> np.ndarray:
        """See `StoredView`."""
        return np.ascontiguousarray(self._image("rgb", 3, "uint8")[..., ::-1])

    def depth_image(self) -> np.ndarray:
        """See `EncodedView`."""
        return self._image("depth", None, "uint16")

    def _image(self, name: str, channels: int | None, dtype: str) -> np.ndarray:
        return check_planes(self.files.image(name, self.frame), channels, f"{name} of image {self.frame} in {self.files.place}", dtype)

    def masks(self) -> list[Masks]:
        """See `EncodedView`: from crops of PNG files in scene folders, from run lengths in shards."""
        files, infos = self.files, self.gt_info
        if not isinstance(files, SceneFolder):
            both = [files.masks(name, self.frame, len(infos)) for name in ("mask", "mask_visib")]
            return [Masks(*(find_runs(mask) for mask in pair)) for pair in zip(*both, strict=True)]
        return [
            Masks(
                _read_runs(files, "mask", self.frame, index, info["bbox_obj"], info["px_count_valid"]),
                _read_runs(files, "mask_visib", self.frame, index, info["bbox_visib"], info["px_count_visib"]),
            )
            for index, info in enumerate(infos)
        ]


def _read_runs(files: SceneFolder, name: str, frame: int, index: int, box: list[int], count: int) -> Runs:
    """Read a mask within its box, or the whole of it, if the box does not hold the pixels that the annotations count."""
    width, height = files.size or (0, 0)
    left, top = max(0, box[0]), max(0, box[1])
    rows, columns = slice(top, max(top, min(height, box[1] + box[3] + 1))), slice(left, max(left, min(width, box[0] + box[2] + 1)))
    if box[2] >= 0 and rows.stop > rows.start and columns.stop > columns.start:
        path = f"{files.images(name)}{os.sep}{frame:06d}_{index:06d}.png"
        data = read_file_if_present(path, MAX_IMAGE_FILE, DatasetError)
        crop = None if data is None else decode_grey_crop(data, (width, height), rows, columns)
        if crop is not None:
            runs = find_runs(crop > 0, top, left)
            if runs.count == count:
                return runs
    return find_runs(files.mask(name, frame, index))


def find_runs(mask: np.ndarray, top: int = 0, left: int = 0) -> Runs:
    """Runs of a mask (H, W), or of a crop of it that begins at a row and a column."""
    return find_run_boundaries(mask.astype(np.uint8), top, left).runs_of(1)
