"""Exporter of point clouds: a PLY file a view, with colour, object and instance of each point."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.exporters.base import SharedFiles
from synpick_warp.exporters.bop.points.cloud_files import FOLDER, cloud_list, commit_scenes, write_view
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.exporters.writing.notes import note_files, write_notes


class PointsExporter(SceneExporter):
    """`Exporter` of point clouds. A scene is a folder of clouds in the frame of the world, and a list of them."""

    staging = "points"

    write_view = staticmethod(write_view)

    @staticmethod
    def folder_name(split: str) -> str:
        return str(FOLDER / split)

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles(note_files(layout), (), (*(FOLDER / split for split in layout.folders), FOLDER))

    def write_constants(self) -> list[Path]:
        context = self._context
        with output_errors(self._out):
            for folder in reversed(self.shared_files(context.layout).folders):
                (self._out / folder).mkdir(exist_ok=True)
            return write_notes(self._out, context.settings, context.names, self._cameras)

    def places(self, episode: int) -> list[Path]:
        folder, scenes = self._folder(self.scene_ids(episode)[0]).relative_to(self._out), self.scene_ids(episode)
        return [*map(cloud_list, scenes), *(folder / f"{scene:06d}" for scene in scenes)]

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        split = self._context.layout.folder(scenes[0][1] // len(self._cameras))
        return commit_scenes, (scenes, self._out, split, images)
