"""BOP data sets, "scenewise": one scene a camera and episode, written by a pool of processes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import DataSet, view_bytes
from synpick_warp.exporters.bop_models import write_constants
from synpick_warp.exporters.bop_scene import SceneSettings, drop_scenes, finish_episode, make_scene
from synpick_warp.exporters.bop_view import MILLIMETERS, ViewSettings, ViewTruth, write_view
from synpick_warp.exporters.files import PARTIAL, output_error
from synpick_warp.exporters.pool import WriterPool
from synpick_warp.exporters.targets import BOP19, BOP24, join_targets, write_scene_targets
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.outcome import Ending
from synpick_warp.scenes.shapes import Camera

_FOLDER = "bop"
"""In `PARTIAL`."""

@dataclass(eq=False)
class _Episode:
    """An arrangement of an episode whose files are being written."""

    scenes: tuple[Path, ...]
    """Hidden folder of each camera's scene."""
    pending: int = 0
    """Views that are not on the disk yet."""
    end: EpisodeEnd | None = None
    whole: Callable[[], None] | None = None
    """Comes with the end."""


class BopExporter:
    """An `Exporter`. Camera c of episode k becomes scene `cameras · k + c`.

    A scene grows in a hidden folder, and moves to its place when it is whole: if the bake is killed, whole scenes stay.
    """

    records = False

    def __init__(self, data_set: DataSet) -> None:
        """See `Exporter`."""
        out, config = data_set.out, data_set.config
        self._data_set = data_set
        self._out = out
        self._config = config.bop
        self._cameras = data_set.cameras
        self._pool = data_set.pool
        self._split = out / config.bop.split
        self._suffix = f".{config.bop.color_format}"
        self._object_ids = tuple(entry.obj_id for entry in data_set.catalog.entries)
        self._views = tuple(self._view_settings(camera) for camera in data_set.cameras)
        self._episodes: dict[int, _Episode] = {}
        self._begun = 0

    @staticmethod
    def slot_bytes(config: Config) -> int:
        """See `Exporter`."""
        return view_bytes(config)

    @staticmethod
    def join(out: Path, config: Config, pool: WriterPool) -> list[Path]:
        """See `Exporter`: the targets of an evaluation."""
        parts = out / PARTIAL / _FOLDER / "targets"
        try:
            parts.parent.mkdir(exist_ok=True)
            shutil.rmtree(parts, ignore_errors=True)
            for name in (parts, parts / BOP19, parts / BOP24):
                name.mkdir()
            for scene in sorted((out / config.bop.split).iterdir()):
                pool.submit(write_scene_targets, (), (scene, parts, config.bop.target_visibility), path=scene)
            pool.wait()
            join_targets(parts, out)
        except OSError as error:
            raise output_error(out, error) from error
        return [Path(BOP19), Path(BOP24)]

    def write_constants(self) -> list[Path]:
        """See `Exporter`: models, camera and notes."""
        try:
            self._split.mkdir(exist_ok=True)
            return write_constants(self._out, self._data_set.config, self._data_set.catalog, self._cameras)
        except OSError as error:
            raise output_error(self._out, error) from error

    def write(self, batch: FrameBatch) -> None:
        """See `Exporter`."""
        for view in range(len(batch)):
            number, camera = int(batch.episode[view]), int(batch.camera[view])
            episode = self._episodes.get(number) or self._begin(number)
            scene = episode.scenes[camera]
            episode.pending += 1
            self._pool.submit(
                write_view,
                (batch.color[view], batch.depth[view], batch.instance[view], batch.amodal[view]),
                (scene, self._views[camera], _truth(batch, view)),
                path=self._place(number, camera),
                done=partial(self._view_done, number, episode),
            )

    def tick(self, batch: TickBatch) -> None:
        """See `Exporter`: what BOP has of a tick comes with its views."""

    def end(self, end: EpisodeEnd, whole: Callable[[], None]) -> None:
        """See `Exporter`."""
        episode = self._episodes.pop(end.episode, None)
        if episode is None:
            whole()
        else:
            episode.end, episode.whole = end, whole
            self._finish_if_whole(end.episode, episode)
        self._pool.poll()

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: the folders of the scenes."""
        places = (self._place(episode, camera) for camera in range(len(self._cameras)))
        return [place.relative_to(self._out) for place in places if os.path.lexists(place)]

    def close(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def abort(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def _begin(self, number: int) -> _Episode:
        # A number of its own for every arrangement: the last one's folders may not be removed yet.
        self._begun += 1
        names = (f"{self._place(number, camera).name}-{self._begun}" for camera in range(len(self._cameras)))
        episode = _Episode(tuple(self._out / PARTIAL / _FOLDER / name for name in names))
        try:
            (self._out / PARTIAL / _FOLDER).mkdir(exist_ok=True)
            for scene in episode.scenes:
                make_scene(scene, self._config.masks)
        except OSError as error:
            raise output_error(episode.scenes[0], error) from error
        self._episodes[number] = episode
        return episode

    def _view_done(self, number: int, episode: _Episode) -> None:
        episode.pending -= 1
        self._finish_if_whole(number, episode)

    def _finish_if_whole(self, number: int, episode: _Episode) -> None:
        if episode.end is None or episode.pending:
            return
        if not Ending(episode.end.ending).delivers:
            self._pool.submit(drop_scenes, (), (episode.scenes,), path=episode.scenes[0], done=episode.whole)
            return
        places = tuple(self._place(number, camera) for camera in range(len(self._cameras)))
        settings = SceneSettings(
            split=self._config.split,
            frames=episode.end.frames,
            width=self._cameras[0].width,
            height=self._cameras[0].height,
            color_suffix=self._suffix,
            coco=self._config.coco,
            object_ids=self._object_ids,
        )
        scenes = tuple(zip(episode.scenes, places, strict=True))
        self._pool.submit(finish_episode, (), (scenes, settings), path=places[0], done=episode.whole)

    def _place(self, episode: int, camera: int) -> Path:
        return self._split / f"{len(self._cameras) * episode + camera:06d}"

    def _view_settings(self, camera: Camera) -> ViewSettings:
        record = {
            "cam_K": camera.matrix.ravel().tolist(),
            "cam_R_w2c": camera.rotation.ravel().tolist(),
            "cam_t_w2c": (MILLIMETERS * camera.translation).tolist(),
            "depth_scale": self._config.depth_scale,
        }
        return ViewSettings(self._suffix, self._config.jpeg_quality, self._config.masks, self._config.coco, record)


def _truth(batch: FrameBatch, view: int) -> ViewTruth:
    present = np.flatnonzero(batch.object_id[view] >= 0)
    return ViewTruth(
        frame=int(batch.frame[view]),
        instance_id=present,
        object_id=batch.object_id[view][present],
        pose=batch.pose[view][present],
        pixels=batch.pixels[view][present],
        boxes=batch.boxes[view][present],
    )
