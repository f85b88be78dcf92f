"""Exporter of BOP datasets as webdataset shards: one tar file per scene that holds its complete views, for sequential reading."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from synpick_warp.configs.cell.rig import lens_map
from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.exporters.base import SharedFiles
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages, constant_files
from synpick_warp.exporters.bop.shards.card import CARD_FILE, CardContent, SplitContent, hub_splits, make_card
from synpick_warp.exporters.bop.shards.tar_files import (
    commit_shards,
    find_shards,
    known_keys,
    list_keys,
    write_layer,
    write_view,
)
from synpick_warp.exporters.writing.files import PARTIAL, join_lines, output_errors, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool

KEYS_FILE = "key_to_shard.json"
"""Index file: key of a view -> index of its shard."""


class ShardsExporter(SceneExporter):
    """`Exporter` of one tar file per scene, named by scene_id; a scene of more than 1,000 views has further ones.

    Shard indices depend on the scene only, so an episode's shards can be committed when it ends, independently of other episodes.
    """

    staging = "shards"
    write_view = staticmethod(write_view)
    write_layer = staticmethod(write_layer)

    @staticmethod
    def folder_name(split: str) -> str:
        """See `SceneExporter`: the toolkit's name."""
        return f"{split}_web"

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        """See `Exporter`."""
        splits = ShardsExporter.folders(layout)
        return SharedFiles(constant_files(layout), (*(split / KEYS_FILE for split in splits), Path(CARD_FILE)), splits)

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        """See `Exporter`: the index of views and shards of each split, and the dataset card."""
        layout = settings.layout
        cameras = layout.cameras
        scenes = [scene for episode in episodes for scene in range(cameras * episode, cameras * (episode + 1))]
        contents = [
            _write_keys(out, name, split, pool, scenes)
            for name, split in zip(hub_splits(layout), ShardsExporter.folders(layout), strict=True)
        ]
        with output_errors(out / CARD_FILE):
            write_atomically(out / CARD_FILE, make_card(_describe(settings, contents)).encode())
        return [*(Path(split.folder) / KEYS_FILE for split in contents), Path(CARD_FILE)]

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: the shards of its scenes."""
        scenes = (self.scene_id(episode, camera) for camera in range(len(self._cameras)))
        return sorted(path.relative_to(self._out) for scene in scenes for path in find_shards(scene, self._folder(scene)))

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return commit_shards, (scenes, self._folder(scenes[0][1]), images, tuple(view.layers for view in self._views))


def _describe(settings: ExportSettings, splits: list[SplitContent]) -> CardContent:
    """What the card of a data set says."""
    bake, bop = settings.bake, settings.bop
    return CardContent(
        splits=tuple(splits),
        embedded=not (bake.models or bake.lights),
        color_suffix=f".{bop.color_format}",
        masks=bop.masks,
        instances=settings.objects,
        layers=settings.render.layers,
        effects=settings.effects,
        distorted=any(lens_map(row) is not None for row in settings.rig.rows),
    )


def _write_keys(out: Path, name: str, split: Path, pool: WriterPool, scenes: Sequence[int]) -> SplitContent:
    """Write the index of the views and shards of those scenes that a split has; returns their numbers and the size of the shards."""
    parts = out / PARTIAL / ShardsExporter.staging / "keys"
    with output_errors(out / split):
        parts.parent.mkdir(exist_ok=True)
        shutil.rmtree(parts, ignore_errors=True)
        parts.mkdir()
        shards, size = 0, 0
        for shard in (shard for scene in scenes for shard in find_shards(scene, out / split)):
            shards, size = shards + 1, size + shard.stat().st_size
            if (known := known_keys(shard)).exists():
                known.rename(parts / shard.name)
            else:
                pool.submit(list_keys, (), (shard, parts), path=shard)
        pool.wait()
        names = sorted(os.listdir(parts), key=lambda part: (len(part), part))
        write_atomically(out / split / KEYS_FILE, join_lines((parts / part for part in names), b"{", b"}\n"))
        views = sum((parts / part).read_bytes().count(b"\n") for part in names)
        return SplitContent(name, split.name, views, shards, size)
