"""Base class of BOP exporters: each camera of an episode is a scene, each view a task; scenes of an episode are committed together."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar

from synpick_warp.configs.cell.cameras import COLOR, DEPTH, MASKS
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Bop
from synpick_warp.exporters.base import ExportContext, StoredScene, view_bytes
from synpick_warp.exporters.bop import view as bop_view
from synpick_warp.exporters.bop.graph import FrameSupport, find_supports
from synpick_warp.exporters.bop.keypoints import sample_keypoints
from synpick_warp.exporters.bop.shared.models import MODEL_FOLDERS, describe_dataset, write_models
from synpick_warp.exporters.bop.shared.toolkit import PARAMS_FILE, format_dataset_params
from synpick_warp.exporters.staging import EpisodeExporter, StagedEpisode
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.exporters.writing.notes import CAMERA_FILE, NOTES_FILE, camera_files, write_cameras
from synpick_warp.exporters.writing.pool import WriteTask
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch


def constant_files(layout: DataLayout) -> tuple[Path, ...]:
    """Names of the files that all scenes share."""
    return tuple(map(Path, (*MODEL_FOLDERS, CAMERA_FILE, *camera_files(layout), NOTES_FILE, PARAMS_FILE)))


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
        """Create the staging folder of a scene, and its subfolders."""
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
                NOTES_FILE: describe_dataset(context.settings, context.catalog, self._cameras),
                PARAMS_FILE: format_dataset_params(context.settings, context.catalog, self._cameras),
            }
            for name in MODEL_FOLDERS:
                write_models(self._out / name, context.catalog, self._bop.graph)
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
