"""BOP data sets as webdataset: tar files of whole views, one a scene, that are read in one go and never listed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.bop.scene_exporter import SceneExporter
from synpick_warp.exporters.bop.shard_parts import finish_shards, list_keys, shard_number, shards_of, write_shard_layer, write_shard_view
from synpick_warp.exporters.writing.files import PARTIAL, output_error, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool

KEYS_FILE = "key_to_shard.json"
"""In which shard a view is."""


class ShardsExporter(SceneExporter):
    """An `Exporter` of one tar file a scene, with the scene's number; a scene of more than 1,000 views has further ones.

    Numbers depend on the scene alone: an episode's shards are whole when it ends, whatever becomes of the others.
    """

    hidden = "shards"
    write_view = staticmethod(write_shard_view)

    @staticmethod
    def split(config: Config) -> str:
        """See `SceneExporter`: as the toolkit names it."""
        return f"{config.bop.split}_web"

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool) -> list[Path]:
        """See `Exporter`: which view is in which shard."""
        split, parts = out / ShardsExporter.split(config), out / PARTIAL / ShardsExporter.hidden / "keys"
        try:
            parts.parent.mkdir(exist_ok=True)
            shutil.rmtree(parts, ignore_errors=True)
            parts.mkdir()
            for shard in sorted(split.glob("shard-*.tar")):
                pool.submit(list_keys, (), (shard, parts), path=shard)
            pool.wait()
            lines = [line for part in sorted(parts.iterdir(), key=shard_number) for line in part.read_bytes().splitlines()]
            write_atomically(split / KEYS_FILE, b"{\n" + b",\n".join(lines) + b"\n}\n")
        except OSError as error:
            raise output_error(split, error) from error
        return [(split / KEYS_FILE).relative_to(out)]

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: the shards of its scenes."""
        scenes = (self.scene_id(episode, camera) for camera in range(len(self._cameras)))
        return sorted(path.relative_to(self._out) for scene in scenes for path in shards_of(scene, self._split))

    def _make_scene(self, scene: Path) -> None:
        scene.mkdir()

    def _layer_task(self, scene: Path, number: int, name: str, frame: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return write_shard_layer, (scene, number, name, frame)

    def _finish_task(self, scenes: tuple[tuple[Path, int], ...], frames: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return finish_shards, (scenes, self._split, frames, self._layers)
