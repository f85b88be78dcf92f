"""BOP data sets, "scenewise": one folder a scene, written by a pool of processes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.bop.scene import SceneSettings, finish_episode, make_scene
from synpick_warp.exporters.bop.scene_exporter import SceneExporter
from synpick_warp.exporters.bop.targets import BOP19, BOP24, join_targets, write_scene_targets
from synpick_warp.exporters.bop.view import write_layer, write_view
from synpick_warp.exporters.writing.files import PARTIAL, output_error
from synpick_warp.exporters.writing.pool import WriterPool


class BopExporter(SceneExporter):
    """An `Exporter` of folders with a file for each picture and mask."""

    hidden = "bop"
    write_view = staticmethod(write_view)

    def __init__(self, context: ExportContext) -> None:
        """See `Exporter`."""
        super().__init__(context)
        self._object_ids = tuple(entry.obj_id for entry in context.catalog.entries)

    @staticmethod
    def split(config: Config) -> str:
        """See `SceneExporter`."""
        return config.bop.split

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool) -> list[Path]:
        """See `Exporter`: the targets of an evaluation."""
        parts = out / PARTIAL / BopExporter.hidden / "targets"
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

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: the folders of the scenes."""
        places = (self._place(self.scene_id(episode, camera)) for camera in range(len(self._cameras)))
        return [place.relative_to(self._out) for place in places if os.path.lexists(place)]

    def _make_scene(self, scene: Path) -> None:
        make_scene(scene, self._config.masks, self._layers)

    def _layer_task(self, scene: Path, number: int, name: str, frame: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return write_layer, (scene, name, frame)

    def _finish_task(self, scenes: tuple[tuple[Path, int], ...], frames: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        settings = SceneSettings(
            split=self._config.split,
            frames=frames,
            width=self._cameras[0].width,
            height=self._cameras[0].height,
            color_suffix=self._suffix,
            coco=self._config.coco,
            object_ids=self._object_ids,
        )
        return finish_episode, (tuple((scene, self._place(number)) for scene, number in scenes), settings)

    def _place(self, scene: int) -> Path:
        return self._split / f"{scene:06d}"
