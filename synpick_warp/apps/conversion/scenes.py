"""Views of a scene that is converted, as exporters take them: image files byte for byte, annotations unchanged, masks as run lengths."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.view_files import SceneFiles, ViewRecords
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import Buffer
from synpick_warp.exporters.writing.rle import Masks, Runs, find_runs


class StoredViewFiles:
    """Files of one stored view as a `StoredView`: bytes, records, images and run lengths of masks."""

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
        """Annotation records of the view: camera, gt, gt_info. Cached."""
        return self.files.records(self.frame)

    @property
    def camera(self) -> dict[str, Any]:
        """Entry in scene_camera.json."""
        return self._records.camera

    @property
    def gt(self) -> list[dict[str, Any]]:
        """Entries in scene_gt.json, one per instance."""
        return self._records.gt

    @property
    def gt_info(self) -> list[dict[str, Any]]:
        """Entries in scene_gt_info.json, one per instance."""
        return self._records.gt_info

    @property
    def graph(self) -> dict[str, Any] | None:
        """Entry in scene_graph.json; None: there is none."""
        return self.files.graph(self.frame)

    @property
    def color(self) -> tuple[str, Buffer]:
        """Suffix and bytes of the colour file, as stored."""
        return self.files.image_file("rgb", self.frame)

    @property
    def depth(self) -> Buffer:
        """Bytes of the depth file (PNG), as stored."""
        return self.layer("depth")

    def layer(self, name: str) -> Buffer:
        """Bytes of a layer's file, as stored; raises DatasetError if it is no PNG."""
        suffix, data = self.files.image_file(name, self.frame)
        if suffix != ".png":
            raise DatasetError(f"{name} of image {self.frame} in {self.files.place} is a {suffix} file, expected: .png; {ADVICE}")
        return data

    def color_image(self) -> np.ndarray:
        """Decoded colour image, sRGB, RGB order (H, W, 3) uint8."""
        return np.ascontiguousarray(self.files.typed_image("rgb", self.frame, 3, "uint8")[..., ::-1])

    def depth_image(self) -> np.ndarray:
        """Decoded depth image (H, W) uint16 in counts."""
        return self.files.typed_image("depth", self.frame, None, "uint16")

    def masks(self) -> list[Masks]:
        """Run lengths of the amodal and visible mask of each instance; decoded within its box where that suffices."""
        return [
            Masks(
                self._read_runs("mask", index, info["bbox_obj"], info["px_count_valid"]),
                self._read_runs("mask_visib", index, info["bbox_visib"], info["px_count_visib"]),
            )
            for index, info in enumerate(self.gt_info)
        ]

    def _read_runs(self, name: str, index: int, box: list[int], count: int) -> Runs:
        """Runs of a mask, decoded within its box; if that has not exactly `count` pixels, as annotated, the whole mask is decoded."""
        width, height = self.files.image_size(self.frame)
        left, top = max(0, box[0]), max(0, box[1])
        rows, columns = slice(top, max(top, min(height, box[1] + box[3] + 1))), slice(left, max(left, min(width, box[0] + box[2] + 1)))
        if box[2] >= 0 and rows.stop > rows.start and columns.stop > columns.start:
            runs = find_runs(self.files.mask_crop(name, self.frame, index, rows, columns), top, left)
            if runs.count == count:
                return runs
        return find_runs(self.files.mask(name, self.frame, index))


@dataclass(frozen=True, eq=False)
class StoredSceneFiles:
    """`StoredScene` of a scene folder or of shards."""

    files: SceneFiles
    """Files of the scene; none has been read yet, so that this is small when pickled."""
    scene: int
    """BOP scene_id."""
    images: Sequence[int]
    """BOP im_id of each frame."""
    view: Callable[[SceneFiles, int, int], StoredViewFiles] = StoredViewFiles
    """Opens a view, by the scene's files, scene_id and im_id."""

    @property
    def frames(self) -> int:
        return len(self.images)

    def views(self, frames: range) -> Iterator[StoredViewFiles]:
        """Views of these frames (indices, not im_ids)."""
        return (self.view(self.files, self.scene, self.images[frame]) for frame in frames)
