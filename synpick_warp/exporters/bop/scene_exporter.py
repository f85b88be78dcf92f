"""What exporters of BOP's scenes share: one scene a camera and episode, a task a view, and episodes that are whole or not there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config
from synpick_warp.configs.sensors import effect_ranges
from synpick_warp.exporters.base import ExportContext, view_bytes
from synpick_warp.exporters.bop.models import write_constants
from synpick_warp.exporters.bop.scene import drop_scenes
from synpick_warp.exporters.bop.view import ViewSettings, make_view_task, shared_record
from synpick_warp.exporters.writing.files import PARTIAL, output_error
from synpick_warp.exporters.writing.pool import WriteTask
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch


@dataclass(eq=False)
class _Episode:
    """An arrangement of an episode whose files are being written."""

    scenes: tuple[Path, ...]
    """Hidden folder of each camera's scene."""
    pending: int = 0
    """Views and layers of views that are not on the disk yet."""
    end: EpisodeEnd | None = None
    whole: Callable[[], None] | None = None
    """Comes with the end."""


class SceneExporter(ABC):
    """An `Exporter`. Camera c of episode k becomes scene `cameras · k + c`.

    A scene grows in a hidden folder, and moves to its place when it is whole: if the bake is killed, whole scenes stay.
    """

    needs_physics = False
    needs_views = True
    hidden: ClassVar[str]
    """Folder in `PARTIAL`."""
    write_view: ClassVar[Callable[..., None]]
    """Task that writes a view: the arrays of `make_view_task`, hidden folder of the scene, `ViewSettings`, `ViewTruth`."""

    def __init__(self, context: ExportContext) -> None:
        """See `Exporter`."""
        config = context.config.bop
        self._context = context
        self._out = context.out
        self._config = config
        self._cameras = context.cameras
        self._pool = context.pool
        self._split = self._out / self.split(context.config)
        self._suffix = f".{config.color_format}"
        self._layers = context.config.render.layers
        effects = tuple(name for name, strengths in effect_ranges(context.config.effects).items() if any(strengths))
        self._views = tuple(
            ViewSettings(self._suffix, config.jpeg_quality, effects, config.masks, config.coco, shared_record(camera, config.depth_scale))
            for camera in context.cameras
        )
        self._episodes: dict[int, _Episode] = {}
        self._begun = 0

    @staticmethod
    @abstractmethod
    def split(config: Config) -> str:
        """Name of the folder of all scenes in the data set."""

    @abstractmethod
    def _make_scene(self, scene: Path) -> None:
        """Make the hidden folder of a scene, and folders in it."""

    @abstractmethod
    def _layer_task(self, scene: Path, number: int, name: str, frame: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        """The task, function and further arguments, that writes a view's layer: hidden folder of the scene, its number, layer, frame."""

    @abstractmethod
    def _finish_task(self, scenes: tuple[tuple[Path, int], ...], frames: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        """The task, function and arguments, that moves whole scenes of so many frames to their places: hidden folders and scene numbers."""

    @abstractmethod
    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""

    @staticmethod
    def slot_bytes(config: Config) -> int:
        """See `Exporter`."""
        return view_bytes(config.cameras.resolution, bool(config.render.layers))

    def write_constants(self) -> list[Path]:
        """See `Exporter`: models, camera and notes."""
        try:
            self._split.mkdir(exist_ok=True)
            return write_constants(self._out, self._context.config, self._context.catalog, self._cameras)
        except OSError as error:
            raise output_error(self._out, error) from error

    def write_views(self, batch: FrameBatch) -> None:
        """See `Exporter`."""
        self._pool.submit_all(self._orders(batch))

    def _orders(self, batch: FrameBatch) -> Iterator[WriteTask]:
        """A task for each view, and for each of its layers."""
        for view in range(len(batch)):
            number, camera = int(batch.episode[view]), int(batch.camera[view])
            episode = self._episodes.get(number) or self._begin(number)
            scene = episode.scenes[camera]
            images, truth = make_view_task(batch, view, self.scene_id(number, camera), self._views[camera])
            tasks = [(type(self).write_view, images, (scene, self._views[camera], truth))]
            for name in self._layers:
                function, arguments = self._layer_task(scene, truth.scene, name, truth.frame)
                tasks.append((function, (batch.layers[name][view],), arguments))
            episode.pending += len(tasks)
            for function, arrays, arguments in tasks:
                yield WriteTask(function, arrays, arguments, self._split / scene.name, partial(self._part_done, number, episode))

    def write_ticks(self, batch: TickBatch) -> None:
        """See `Exporter`: what BOP has of a tick comes with its views."""
        return

    def end_episode(self, end: EpisodeEnd, whole: Callable[[], None]) -> None:
        """See `Exporter`."""
        episode = self._episodes.pop(end.episode, None)
        if episode is None:
            whole()
        else:
            episode.end, episode.whole = end, whole
            self._finish_if_whole(end.episode, episode)
        self._pool.poll()

    def close(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def abort(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def scene_id(self, episode: int, camera: int) -> int:
        """Number of the scene that a camera sees of an episode."""
        return len(self._cameras) * episode + camera

    def _begin(self, number: int) -> _Episode:
        # A number of its own for every arrangement: the last one's folders may not be removed yet.
        self._begun += 1
        hidden = self._out / PARTIAL / self.hidden
        names = (f"{self.scene_id(number, camera):06d}-{self._begun}" for camera in range(len(self._cameras)))
        episode = _Episode(tuple(hidden / name for name in names))
        try:
            hidden.mkdir(exist_ok=True)
            for scene in episode.scenes:
                self._make_scene(scene)
        except OSError as error:
            raise output_error(episode.scenes[0], error) from error
        self._episodes[number] = episode
        return episode

    def _part_done(self, number: int, episode: _Episode) -> None:
        episode.pending -= 1
        self._finish_if_whole(number, episode)

    def _finish_if_whole(self, number: int, episode: _Episode) -> None:
        if episode.end is None or episode.pending:
            return
        if Ending(episode.end.ending).delivers:
            scenes = tuple((scene, self.scene_id(number, camera)) for camera, scene in enumerate(episode.scenes))
            function, arguments = self._finish_task(scenes, episode.end.frames)
        else:
            function, arguments = drop_scenes, (episode.scenes,)
        self._pool.submit(function, (), arguments, path=self._split / f"{self.scene_id(number, 0):06d}", on_done=episode.whole)
