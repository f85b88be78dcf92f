"""Exporter of scenewise BOP datasets: one folder per scene, with a file for each image and mask."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Bop
from synpick_warp.exporters.base import ExportContext, SharedFiles
from synpick_warp.exporters.bop.keypoints import make_category_keys
from synpick_warp.exporters.bop.picks import spool_picks
from synpick_warp.exporters.bop.scene import (
    SceneSettings,
    commit_scenes,
    commit_sensor_scene,
    create_scene_folders,
    write_layer,
    write_view,
)
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages, constant_files
from synpick_warp.exporters.bop.shared.targets import (
    concatenate_targets,
    find_scenes,
    make_scene_targets,
    scene_target_files,
    sensor_suffixes,
    target_files,
    write_scene_targets,
)
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.writing.files import LINES, PARTIAL, output_errors
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.views.picks import PickBatch


class BopExporter(SceneExporter):
    """Exporter of BOP scene folders: images, masks, layers and annotations, with lists of evaluation targets."""

    staging = "bop"
    write_view = staticmethod(write_view)
    write_layer = staticmethod(write_layer)
    has_graph = True

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        points = {obj_id: make_category_keys(keypoints) for obj_id, keypoints in self._keypoints.items()}
        names = context.names.items()
        self._categories = tuple({"id": index, "name": name, "supercategory": "synpick"} | points.get(index, {}) for index, name in names)

    @staticmethod
    def annotates(bop: Bop) -> bool:
        return bop.coco

    @staticmethod
    def folder_name(split: str) -> str:
        return split

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles(constant_files(layout), tuple(map(Path, target_files(layout))), BopExporter.folders(layout))

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        layout = settings.layout
        parts, names, sensors = out / PARTIAL / BopExporter.staging / "targets", target_files(layout), sensor_suffixes(layout)
        with output_errors(out):
            known = (out / LINES).is_dir()
            if known:
                parts = out / LINES
            else:
                parts.parent.mkdir(exist_ok=True)
                shutil.rmtree(parts, ignore_errors=True)
                parts.mkdir()
            for name in names:
                (parts / name).mkdir(exist_ok=known)
            for folder in () if known else layout.folders:
                places = tuple(str(parts / name) for name in scene_target_files(layout, folder))
                for scene in find_scenes(out / folder, layout.scene_ids(episodes)):
                    pool.submit(write_scene_targets, (), (scene, places, settings.bop.target_visibility, sensors), path=scene)
            pool.wait()
            concatenate_targets(parts, out, names)
        return [Path(name) for name in names]

    @staticmethod
    def index_lines(out: Path, settings: ExportSettings, names: Sequence[str]) -> Iterator[tuple[str, bytes]]:
        layout, sensors = settings.layout, sensor_suffixes(settings.layout)
        truths = filter(lambda path: path.name == f"scene_gt{sensors[0]}.json", map(Path, names))
        for scene in sorted((path.parent for path in truths), key=lambda scene: int(scene.name)):
            lists = make_scene_targets(out / scene, settings.bop.target_visibility, sensors)
            for name, lines in zip(scene_target_files(layout, scene.parent.name), lists, strict=False):
                yield f"{name}/0", lines

    def write_picks(self, batch: PickBatch) -> None:
        scenes = self._staged(batch.episode, partial(self._create_scenes, batch.episode)).content
        with output_errors(scenes[0]):
            spool_picks(batch, scenes)

    def places(self, episode: int) -> Iterator[Path]:
        return map(self._place, self.scene_ids(episode))

    def _stage_scene(self, scene: Path, settings: ViewSettings) -> None:
        """Create the staging folder of a scene, with a folder for each kind of images."""
        masks = ("mask", "mask_visib") if settings.masks else ()
        create_scene_folders(scene, (*("rgb",) * settings.color, *("depth",) * settings.depth, *masks, *settings.layers))

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        """Task that completes an episode: writes the annotation files of its scenes, and renames the folders to their places."""
        layout = self._context.layout
        episode = scenes[0][1] // len(self._cameras)
        split, supports = layout.folder(episode), tuple(self._supports.pop(episode, ()))
        settings = tuple(
            SceneSettings(view, split, own, self._categories, layout.scene(0, index)[1], supports)
            for index, (view, own) in enumerate(zip(self._views, images, strict=True))
        )
        if self._context.layout.has_sensors:
            return commit_sensor_scene, (tuple(scene for scene, _ in scenes), self._place(scenes[0][1]), self._out, settings)
        return commit_scenes, (tuple((scene, self._place(scene_id)) for scene, scene_id in scenes), self._out, settings)

    def _place(self, scene_id: int) -> Path:
        """Folder of a scene, relative to the data set; with several sensors the folder that the scenes of an episode share."""
        episode, camera = divmod(scene_id, len(self._cameras))
        return (self._folder(scene_id) / f"{self._context.layout.scene(episode, camera)[0]:06d}").relative_to(self._out)
