"""Exporter of COCO instance segmentation: one annotation file for each split, with visible boxes, for detectors' training code.

Beside BOP's scene_gt_coco.json, which is a file a scene with amodal boxes: here boxes enclose the visible mask, as COCO's readers expect.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Bop
from synpick_warp.exporters.base import SharedFiles
from synpick_warp.exporters.bop.coco.annotation_files import (
    CATEGORIES,
    FOLDER,
    IMAGES,
    PARTS,
    annotation_file,
    commit_scenes,
    write_annotation_files,
    write_categories,
    write_view,
)
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.exporters.writing.notes import note_files, write_notes
from synpick_warp.exporters.writing.pool import WriterPool


class CocoExporter(SceneExporter):
    """`Exporter` of COCO. A scene is a folder of images, and a part of the annotations, from which a file a split is made at the end."""

    writes_depth = False
    staging = "coco"

    write_view = staticmethod(write_view)

    @staticmethod
    def annotates(bop: Bop) -> bool:
        return True

    @staticmethod
    def folder_name(split: str) -> str:
        return FOLDER.name

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        places = tuple(map(annotation_file, layout.folders))
        return SharedFiles((CATEGORIES, *note_files(layout)), places, (IMAGES, PARTS, places[0].parent, FOLDER))

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        with output_errors(out / FOLDER):
            return write_annotation_files(out, settings, episodes)

    def write_constants(self) -> list[Path]:
        names = self._context.names
        write_categories(self._out, names, self._keypoints)
        with output_errors(self._out):
            return [CATEGORIES, *write_notes(self._out, self._context.settings, names, self._cameras)]

    def places(self, episode: int) -> Iterator[Path]:
        return (place for scene in self.scene_ids(episode) for place in (IMAGES / f"{scene:06d}", PARTS / f"{scene:06d}.jsonl"))

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return commit_scenes, (scenes, self._out, images)
