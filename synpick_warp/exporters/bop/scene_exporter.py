"""BOP exporters, the one of scenewise folders and the base class of all: each camera of an episode is a scene, each view a task; scenes of
an episode are committed together."""

import shutil
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar

from synpick_warp.configs.cell.cameras import COLOR, DEPTH, MASKS
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Bop
from synpick_warp.exporters.base import EpisodeExporter, ExportContext, SharedFiles, StagedEpisode, StoredScene, view_bytes
from synpick_warp.exporters.bop import shared
from synpick_warp.exporters.bop import view as bop_view
from synpick_warp.exporters.bop.scene import (
    FrameSupport,
    SceneSettings,
    commit_scenes,
    commit_sensor_scene,
    create_scene_folders,
    find_supports,
    spool_picks,
    write_layer,
    write_view,
)
from synpick_warp.exporters.bop.view import ViewSettings, make_category_keys, sample_keypoints
from synpick_warp.exporters.writing.files import LINES, PARTIAL, output_errors
from synpick_warp.exporters.writing.notes import CAMERA_FILE, NOTES_FILE, camera_files, write_cameras
from synpick_warp.exporters.writing.pool import WriterPool, WriteTask
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.views.picks import PickBatch


def constant_files(layout: DataLayout) -> tuple[Path, ...]:
    """Names of the files that all scenes share."""
    return tuple(map(Path, (*shared.MODEL_FOLDERS, CAMERA_FILE, *camera_files(layout), NOTES_FILE, shared.PARAMS_FILE)))


MAX_RUNNING = 4096
"""Scenes whose paths are remembered: each view of a running one names it."""
SceneImages = tuple[Sequence[int], ...]
"""Images (im_id) of each scene, ascending."""
_Staged = StagedEpisode[tuple[Path, ...]]
"""Staged episode; its content is a folder per camera's scene, named by scene_id, inside the episode's staging folder."""


class SceneExporter(EpisodeExporter[tuple[Path, ...]]):
    """Base of the `Exporter`s of BOP. Camera c of episode k is scene `cameras · k + c`.

    A scene is staged in a hidden folder and renamed to its place when it is complete: a killed bake leaves complete scenes only.
    """

    needs_views = True
    writes_depth = True
    write_view: ClassVar[bop_view.WriteView]
    write_layer: ClassVar[bop_view.WriteLayer | None] = None
    """None: the format has no layers (further images of a view, as normals or flow)."""
    has_graph: ClassVar[bool] = False
    """Whether the format has scene graphs."""

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        settings, bop = context.settings, context.settings.bop
        self._out = context.out
        self._bop = bop
        self._cameras = context.cameras
        self._pool = context.pool
        self._suffix = f".{bop.color_format}"
        layers = settings.render.layers if self.write_layer else ()
        self._scene_path = lru_cache(MAX_RUNNING)(lambda scene: self._folder(scene) / f"{scene:06d}")
        self._supports: dict[int, list[FrameSupport]] = {}
        """Which object rests on which (edges of the support graph), for each frame of each running episode."""
        entries = context.catalog.entries if bop.keypoints and self.annotates(bop) else ()
        self._keypoints = {entry.obj_id: sample_keypoints(entry.mesh.vertices, bop.keypoints) for entry in entries}
        self._views = tuple(
            bop_view.ViewSettings(
                color_suffix=self._suffix,
                jpeg_quality=bop.jpeg_quality,
                effects=settings.effects,
                masks=bop.masks and settings.rig.writes(index, MASKS),
                coco=bop.coco and settings.rig.writes(index, MASKS) and settings.rig.writes(index, COLOR),
                camera=bop_view.make_camera_constants(camera, bop.depth_scale),
                resolution=camera.resolution,
                color=settings.rig.writes(index, COLOR),
                depth=self.writes_depth and settings.rig.writes(index, DEPTH),
                layers=settings.rig.chosen(index, layers),
                keypoints=self._keypoints,
                polygons=bop.polygons,
                graph=bop.graph and self.has_graph,
            )
            for index, camera in enumerate(context.cameras)
        )

    @classmethod
    def folders(cls, layout: DataLayout) -> tuple[Path, ...]:
        """Folders of the splits' scenes, relative to the data set."""
        return tuple(Path(cls.folder_name(split)) for split in layout.folders)

    @staticmethod
    def annotates(bop: Bop) -> bool:
        """Whether this format, with these settings, writes COCO annotations, for which keypoints are sampled."""
        return False

    @staticmethod
    @abstractmethod
    def folder_name(split: str) -> str:
        """Name of the folder that holds the scenes of a split, from its name in BOP."""

    def _folder(self, scene_id: int) -> Path:
        """Folder of the split that a scene belongs to."""
        return self._out / self.folder_name(self._context.layout.folder(scene_id // len(self._cameras)))

    def _stage_scene(self, scene: Path, settings: bop_view.ViewSettings) -> None:
        scene.mkdir()

    @abstractmethod
    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        """Task that completes scenes of these images, given as (staging folder, scene_id), and moves them to their places."""

    @staticmethod
    def slot_bytes(settings: ExportSettings) -> int:
        return view_bytes(settings.rig.largest, settings.objects, bool(settings.render.layers))

    def write_constants(self) -> list[Path]:
        """Create the folders, and write models, camera and notes, or copy them when converting; returns their paths."""
        context = self._context
        with output_errors(self._out):
            for folder in self.folders(context.layout):
                (self._out / folder).mkdir(exist_ok=True)
            names = constant_files(context.layout)
            if context.copy_constants(names):
                return list(names)
            texts = {
                NOTES_FILE: shared.describe_dataset(context.settings, context.catalog, self._cameras),
                shared.PARAMS_FILE: shared.format_dataset_params(context.settings, context.catalog, self._cameras),
            }
            shared.write_models(context.catalog, *(self._out / name for name in shared.MODEL_FOLDERS), mechanics=self._bop.graph)
            write_cameras(self._out, context.layout, self._cameras, self._bop.depth_scale)
            for name, text in texts.items():
                (self._out / name).write_text(text, encoding="utf-8", newline="\n")
            return list(names)

    @cached_property
    def _weights(self) -> dict[int, float]:
        """Weight of each object [N] by obj_id."""
        return {body.obj_id: self._context.settings.physics.gravity * body.mass for body in self._context.catalog.bodies}

    def write_ticks(self, batch: TickBatch) -> None:
        """Collect which object rests on which, for each frame of a tick, if the format writes scene graphs."""
        if not (self._bop.graph and self.has_graph and "support" in batch.tick):
            return
        for episode, frame, support in zip(batch.episode.tolist(), batch.frame.tolist(), find_supports(batch, self._weights), strict=True):
            if frame == 0:
                self._supports[episode] = []
            self._supports[episode].append(support)

    def write_views(self, batch: FrameBatch) -> None:
        self._pool.submit_all(self._make_tasks(batch))

    def _make_tasks(self, batch: FrameBatch) -> Iterator[WriteTask]:
        """One task for each view, and one for each of its layers."""
        for view in range(len(batch)):
            index, camera = int(batch.episode[view]), int(batch.camera[view])
            episode = self._staged(index, partial(self._create_scenes, index))
            scene = episode.content[camera]
            images, truth = bop_view.make_view_task(batch, view, self.scene_ids(index)[camera], self._views[camera])
            place = self._scene_path(truth.scene)
            arguments = (type(self).write_view, scene, self._views[camera], truth)
            yield self._task((episode,), bop_view.write_rendered_view, images, arguments, place, affinity=truth.scene)
            for name in self._views[camera].layers:
                arguments = (type(self).write_layer, scene, truth.scene, name, truth.frame)
                yield self._task((episode,), bop_view.write_rendered_layer, (batch.layers[name][view],), arguments, place)

    def write_stored(self, episode: int, scenes: Sequence[StoredScene]) -> None:
        staged = self._staged(episode, partial(self._create_scenes, episode))
        for stored, scene, settings in zip(scenes, staged.content, self._views, strict=True):
            arguments = (stored, type(self).write_view, type(self).write_layer, settings.layers, scene, settings)
            self._pool.submit_all(
                (self._task((staged,), bop_view.write_stored_views, (), arguments, self._folder(int(scene.name)) / scene.name),)
            )

    def scene_ids(self, episode: int) -> range:
        """BOP scene_id of an episode as seen by each camera."""
        return range(len(self._cameras) * episode, len(self._cameras) * (episode + 1))

    def _create_scenes(self, index: int, folder: Path) -> tuple[Path, ...]:
        """Create the staging folders of an episode's scenes, one per camera, in this folder; returns them."""
        scenes = tuple(folder / f"{scene:06d}" for scene in self.scene_ids(index))
        for scene, settings in zip(scenes, self._views, strict=True):
            self._stage_scene(scene, settings)
        return scenes

    def _commit(self, episode: _Staged, end: EpisodeEnd) -> WriteTask:
        """Task that moves an episode's scenes to their places."""
        numbers = self.scene_ids(end.episode)
        images = tuple(end.images[:: self._context.layout.every[camera]] for camera in range(len(self._cameras)))
        scenes = tuple(zip(episode.content, numbers, strict=True))
        function, arguments = self._commit_task(scenes, images)
        return WriteTask(function, (), arguments, self._folder(numbers[0]) / f"{numbers[0]:06d}")


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
        return SharedFiles(constant_files(layout), tuple(map(Path, shared.target_files(layout))), BopExporter.folders(layout))

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        layout = settings.layout
        parts, names, sensors = out / PARTIAL / BopExporter.staging / "targets", shared.target_files(layout), shared.sensor_suffixes(layout)
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
                places = tuple(str(parts / name) for name in shared.scene_target_files(layout, folder))
                for scene in shared.find_scenes(out / folder, layout.scene_ids(episodes)):
                    pool.submit(shared.write_scene_targets, (), (scene, places, settings.bop.target_visibility, sensors), path=scene)
            pool.wait()
            shared.concatenate_targets(parts, out, names)
        return [Path(name) for name in names]

    @staticmethod
    def index_lines(out: Path, settings: ExportSettings, names: Sequence[str]) -> Iterator[tuple[str, bytes]]:
        layout, sensors = settings.layout, shared.sensor_suffixes(settings.layout)
        truths = filter(lambda path: path.name == f"scene_gt{sensors[0]}.json", map(Path, names))
        for scene in sorted((path.parent for path in truths), key=lambda scene: int(scene.name)):
            lists = shared.make_scene_targets(out / scene, settings.bop.target_visibility, sensors)
            for name, lines in zip(shared.scene_target_files(layout, scene.parent.name), lists, strict=False):
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
