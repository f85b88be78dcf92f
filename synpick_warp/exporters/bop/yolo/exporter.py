"""Exporter of YOLO's text labels, as Ultralytics reads them: segments, boxes and oriented boxes of the visible masks."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.exporters.base import ExportContext, SharedFiles
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.bop.yolo.label_files import CONTENTS, DATA, FOLDER, commit_scenes, image_list, write_data_file, write_view
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.exporters.writing.notes import note_files, write_notes


class YoloExporter(SceneExporter):
    """`Exporter` of YOLO labels. A scene is a folder of images, one of each kind of labels, and a list of its images. The index of a class
    is the rank of its obj_id."""

    writes_depth = False
    staging = "yolo"

    write_view = staticmethod(write_view)

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        classes = tuple(sorted(context.names))
        self._views = tuple(dataclasses.replace(view, classes=classes) for view in self._views)

    @staticmethod
    def folder_name(split: str) -> str:
        return FOLDER.name

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        splits = tuple(FOLDER / kind / split for kind in CONTENTS for split in layout.folders)
        return SharedFiles((DATA, *note_files(layout)), (), (*splits, *(FOLDER / kind for kind in CONTENTS), FOLDER))

    def write_constants(self) -> list[Path]:
        context = self._context
        with output_errors(self._out):
            for folder in reversed(self.shared_files(context.layout).folders):
                (self._out / folder).mkdir(exist_ok=True)
            write_data_file(self._out, context.names, context.layout.folders)
            return [DATA, *write_notes(self._out, context.settings, context.names, self._cameras)]

    def places(self, episode: int) -> list[Path]:
        split, scenes = self._context.layout.folder(episode), self.scene_ids(episode)
        return [*map(image_list, scenes), *(FOLDER / kind / split / f"{scene:06d}" for scene in scenes for kind in CONTENTS)]

    def _stage_scene(self, scene: Path, settings: ViewSettings) -> None:
        scene.mkdir()
        for kind in CONTENTS:
            (scene / kind).mkdir()

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        split = self._context.layout.folder(scenes[0][1] // len(self._cameras))
        return commit_scenes, (scenes, self._out, split, images)
