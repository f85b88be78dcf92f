"""Exporter of BOP datasets as webdataset shards: one tar file per scene that holds its complete views, for sequential reading."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from synpick_warp.configs.schema import Bop, Config
from synpick_warp.configs.sensors import effect_ranges
from synpick_warp.exporters.base import SharedFiles
from synpick_warp.exporters.bop.card import CARD_FILE, CardContent, make_card
from synpick_warp.exporters.bop.scene_exporter import CONSTANTS, SceneExporter
from synpick_warp.exporters.bop.shard_parts import (
    commit_shards,
    find_shards,
    list_keys,
    list_shards,
    shard_index,
    write_shard_layer,
    write_shard_view,
)
from synpick_warp.exporters.writing.files import PARTIAL, output_error, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool

KEYS_FILE = "key_to_shard.json"
"""Index file: key of a view -> index of its shard."""


class ShardsExporter(SceneExporter):
    """`Exporter` of one tar file per scene, named by scene_id; a scene of more than 1,000 views has further ones.

    Shard indices depend on the scene only, so an episode's shards can be committed when it ends, independently of other episodes.
    """

    staging = "shards"
    write_view = staticmethod(write_shard_view)

    @staticmethod
    def split(bop: Bop) -> str:
        """See `SceneExporter`: the toolkit's name."""
        return f"{bop.split}_web"

    @staticmethod
    def shared_files(config: Config) -> SharedFiles:
        """See `Exporter`."""
        split = Path(ShardsExporter.split(config.bop))
        return SharedFiles(CONSTANTS, (split / KEYS_FILE, Path(CARD_FILE)), (split,))

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool) -> list[Path]:
        """See `Exporter`: the index of views and shards, and the dataset card."""
        split, parts = out / ShardsExporter.split(config.bop), out / PARTIAL / ShardsExporter.staging / "keys"
        try:
            parts.parent.mkdir(exist_ok=True)
            shutil.rmtree(parts, ignore_errors=True)
            parts.mkdir()
            shards = list_shards(split)
            for shard in shards:
                pool.submit(list_keys, (), (shard, parts), path=shard)
            pool.wait()
            lines = [line for part in sorted(parts.iterdir(), key=shard_index) for line in part.read_bytes().splitlines()]
            write_atomically(split / KEYS_FILE, b"{\n" + b",\n".join(lines) + b"\n}\n")
            write_atomically(out / CARD_FILE, make_card(_describe(config, shards, len(lines))).encode())
        except OSError as error:
            raise output_error(split, error) from error
        return [(split / KEYS_FILE).relative_to(out), Path(CARD_FILE)]

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: the shards of its scenes."""
        scenes = (self.scene_id(episode, camera) for camera in range(len(self._cameras)))
        return sorted(path.relative_to(self._out) for scene in scenes for path in find_shards(scene, self._split))

    def _stage_scene(self, scene: Path) -> None:
        scene.mkdir()

    def _layer_task(self, scene: Path, scene_id: int, name: str, frame: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return write_shard_layer, (scene, scene_id, name, frame)

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], frames: int) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return commit_shards, (scenes, self._split, frames, self._layers)


def _describe(config: Config, shards: list[Path], views: int) -> CardContent:
    """What the card of a data set says."""
    bake, bop = config.bake, config.bop
    return CardContent(
        split=bop.split,
        views=views,
        shards=len(shards),
        bytes=sum(shard.stat().st_size for shard in shards),
        embedded=not (bake.models or bake.lights),
        color_suffix=f".{bop.color_format}",
        masks=bop.masks,
        instances=config.arrangement.max_objects,
        layers=config.render.layers,
        effects=tuple(name for name, limits in effect_ranges(config.effects).items() if any(limits)),
    )
