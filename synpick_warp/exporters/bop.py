"""BOP data sets, "scenewise": one scene a camera and episode, written by a pool of processes."""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.configs.sensors import strength_ranges
from synpick_warp.exporters.bop_models import CAMERA_FILE, MODEL_FOLDERS, NOTES_FILE, write_constants
from synpick_warp.exporters.bop_scene import SceneSettings, drop_scenes, finish_episode, make_scene
from synpick_warp.exporters.bop_view import MILLIMETERS, ViewSettings, ViewTruth, write_layer, write_view
from synpick_warp.exporters.files import PARTIAL, output_error, prepare_output
from synpick_warp.exporters.pool import WriterPool, shared_bytes
from synpick_warp.exporters.targets import BOP19, BOP24, join_targets, write_scene_targets
from synpick_warp.frames import EFFECTS, EpisodeEnd, FrameBatch
from synpick_warp.outcome import Ending
from synpick_warp.scenes.shapes import Camera, Catalog

_PIXEL_BYTES = (3, 2, 1, 4)
"""Of `FrameBatch`'s color, depth, instance and amodal."""
_DIGITS = 6
"""Decimal places of what is told of light and camera."""
JPEG_QUALITY = "jpeg_quality"
"""The one of EFFECTS that is the writer's to make."""
_LAYER_BYTES = 12
"""Of a pixel of the largest layer."""


@dataclass(eq=False)
class _Episode:
    """An arrangement of an episode whose files are being written."""

    scenes: tuple[Path, ...]
    """Hidden folder of each camera's scene."""
    pending: int = 0
    """Views and layers of views that are not on the disk yet."""
    end: EpisodeEnd | None = None


class BopExporter:
    """An `Exporter`. Camera c of episode k becomes scene `cameras · k + c`.

    A scene grows in a hidden folder, and moves to its place when it is whole: if the bake is killed, whole scenes stay.
    """

    def __init__(self, out: Path, config: Config, catalog: Catalog, cameras: tuple[Camera, ...], episodes: int, pool: WriterPool) -> None:
        """
        Args:
            episodes: How many the bake is to make; named in dataset_info.md.
            pool: The exporter does not close it, but ends it in `abort`.

        Raises:
            OutputError: The folder exists and is not empty, or cannot be written.
        """
        prepare_output(out)
        self._out = out
        self._config = config.bop
        self._layers = config.render.layers
        self._cameras = cameras
        self._pool = pool
        self._split = out / config.bop.split
        self._suffix = f".{config.bop.color_format}"
        self._effects = tuple(name for name, strengths in strength_ranges(config.effects).items() if any(strengths))
        self._object_ids = tuple(entry.obj_id for entry in catalog.entries)
        self._views = tuple(self._view_settings(camera) for camera in cameras)
        self._episodes: dict[int, _Episode] = {}
        self._begun = 0
        try:
            self._split.mkdir(parents=True)
            (out / PARTIAL).mkdir()
            write_constants(out, config, catalog, cameras, episodes)
        except OSError as error:
            self._remove_all()
            raise output_error(out, error) from error

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
                (scene, self._views[camera], self._truth(batch, view)),
                path=self._place(number, camera),
                done=partial(self._part_done, number, episode),
            )
            for name in self._layers:
                episode.pending += 1
                self._pool.submit(
                    write_layer,
                    (batch.layers[name][view],),
                    (scene, name, int(batch.frame[view])),
                    path=self._place(number, camera),
                    done=partial(self._part_done, number, episode),
                )

    def end(self, end: EpisodeEnd) -> None:
        """See `Exporter`."""
        episode = self._episodes.pop(end.episode, None)
        if episode is not None:
            episode.end = end
            self._finish_if_whole(end.episode, episode)
        self._pool.poll()

    def close(self) -> None:
        """See `Exporter`."""
        self._pool.wait()
        self._episodes.clear()
        parts = self._out / PARTIAL / "targets"
        try:
            for scene in sorted(self._split.iterdir()):
                self._pool.submit(write_scene_targets, (), (scene, parts, self._config.target_visibility), path=scene)
            self._pool.wait()
            join_targets(parts, self._out)
            shutil.rmtree(self._out / PARTIAL)
        except OSError as error:
            raise output_error(self._out, error) from error

    def abort(self) -> None:
        """See `Exporter`. Without any whole scene, nothing stays at all."""
        self._pool.abort()
        self._episodes.clear()
        shutil.rmtree(self._out / PARTIAL, ignore_errors=True)
        with contextlib.suppress(OSError):
            self._split.rmdir()
            self._remove_all()

    def _remove_all(self) -> None:
        """Remove what the exporter made, but no whole scene."""
        for name in (PARTIAL, *MODEL_FOLDERS):
            shutil.rmtree(self._out / name, ignore_errors=True)
        for name in (CAMERA_FILE, NOTES_FILE, BOP19, BOP24):
            (self._out / name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._split.rmdir()

    def _begin(self, number: int) -> _Episode:
        # A number of its own for every arrangement: the last one's folders may not be removed yet.
        self._begun += 1
        names = (f"{self._place(number, camera).name}-{self._begun}" for camera in range(len(self._cameras)))
        episode = _Episode(tuple(self._out / PARTIAL / name for name in names))
        for scene in episode.scenes:
            try:
                make_scene(scene, self._config.masks, self._layers)
            except OSError as error:
                raise output_error(scene, error) from error
        self._episodes[number] = episode
        return episode

    def _part_done(self, number: int, episode: _Episode) -> None:
        episode.pending -= 1
        self._finish_if_whole(number, episode)

    def _finish_if_whole(self, number: int, episode: _Episode) -> None:
        if episode.end is None or episode.pending:
            return
        if not Ending(episode.end.ending).delivers:
            self._pool.submit(drop_scenes, (), (episode.scenes,), path=episode.scenes[0])
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
        self._pool.submit(finish_episode, (), (tuple(zip(episode.scenes, places, strict=True)), settings), path=places[0])

    def _place(self, episode: int, camera: int) -> Path:
        return self._split / f"{len(self._cameras) * episode + camera:06d}"

    def _view_settings(self, camera: Camera) -> ViewSettings:
        record = {
            "cam_K": camera.matrix.ravel().tolist(),
            "cam_R_w2c": camera.rotation.ravel().tolist(),
            "cam_t_w2c": (MILLIMETERS * camera.translation).tolist(),
            "depth_scale": self._config.depth_scale,
        }
        return ViewSettings(self._suffix, self._config.masks, self._config.coco, record)

    def _truth(self, batch: FrameBatch, view: int) -> ViewTruth:
        strengths: dict[str, float] = dict(zip(EFFECTS, batch.effects[view].tolist(), strict=True))
        present = np.flatnonzero(batch.object_id[view] >= 0)
        return ViewTruth(
            frame=int(batch.frame[view]),
            jpeg_quality=round(strengths[JPEG_QUALITY]) if JPEG_QUALITY in self._effects else self._config.jpeg_quality,
            circumstances=_circumstances(batch, view, {name: strengths[name] for name in self._effects}),
            instance_id=present,
            object_id=batch.object_id[view][present],
            pose=batch.pose[view][present],
            pixels=batch.pixels[view][present],
            boxes=batch.boxes[view][present],
        )


def view_bytes(camera: Camera) -> int:
    """Room that a view's images, or one of its layers, take at most in the pool's shared memory [B]."""
    pixels = camera.height * camera.width
    return max(shared_bytes(pixels * size for size in _PIXEL_BYTES), shared_bytes((pixels * _LAYER_BYTES,)))


def _circumstances(batch: FrameBatch, view: int, effects: dict[str, float]) -> dict[str, Any]:
    """A view's light, and what its camera did to colour if that is anything, for scene_camera.json."""
    direction = batch.light_direction[view]
    light = {
        "map": str(batch.light_name[view]),
        "turn": round(float(batch.light_turn[view]), _DIGITS),
        "exposure": round(float(batch.light_exposure[view]), _DIGITS),
        "direction": [round(part, _DIGITS) for part in direction.tolist()] if direction.any() else None,
    }
    return {"light": light} | ({"effects": {name: round(value, _DIGITS) for name, value in effects.items()}} if effects else {})
