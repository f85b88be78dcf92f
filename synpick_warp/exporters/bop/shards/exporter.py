"""Exporter of BOP datasets as webdataset shards: one tar file per scene that holds its complete views, for sequential reading."""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from synpick_warp.configs.dataset import MAX_SHARD_SCENES, DataLayout, ExportSettings
from synpick_warp.exporters.base import SharedFiles
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages, constant_files
from synpick_warp.exporters.bop.shards.card import CARD_FILE, SplitContent, hub_splits, make_card
from synpick_warp.exporters.bop.shards.tar_files import (
    commit_shards,
    find_shards,
    key_lines,
    list_keys,
    shard_index,
    write_layer,
    write_view,
)
from synpick_warp.exporters.writing.files import LINES, PARTIAL, join_lines, output_errors, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool

KEYS_FILE = "key_to_shard.json"
"""Index file: key of a view -> index of its shard."""
_SIZES = "sizes"
"""Name in LINES: size [B] and number of views of each shard, a line each."""


class ShardsExporter(SceneExporter):
    """`Exporter` of one tar file per scene, named by scene_id; a scene of more than 1,000 views has further ones.

    Shard indices depend on the scene only, so an episode's shards can be committed when it ends, independently of other episodes.
    """

    staging = "shards"
    write_view = staticmethod(write_view)
    write_layer = staticmethod(write_layer)

    @staticmethod
    def folder_name(split: str) -> str:
        return f"{split}_web"

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        splits = ShardsExporter.folders(layout)
        return SharedFiles(constant_files(layout), (*(split / KEYS_FILE for split in splits), Path(CARD_FILE)), splits)

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        layout = settings.layout
        cameras = layout.cameras
        scenes = [scene for episode in episodes for scene in range(cameras * episode, cameras * (episode + 1))]
        contents = [
            _join_known(out, name, split) if (out / LINES).is_dir() else _write_keys(out, name, split, pool, scenes)
            for name, split in zip(hub_splits(layout), ShardsExporter.folders(layout), strict=True)
        ]
        with output_errors(out / CARD_FILE):
            write_atomically(out / CARD_FILE, make_card(settings, contents).encode())
        return [*(Path(split.folder) / KEYS_FILE for split in contents), Path(CARD_FILE)]

    @staticmethod
    def index_lines(out: Path, settings: ExportSettings, names: Sequence[str]) -> Iterator[tuple[str, bytes]]:
        """For each shard keys of its views, in parts of MAX_SHARD_SCENES shards; its size [B] and number of views."""
        splits = ShardsExporter.folders(settings.layout)
        shards = filter(lambda path: path.parent in splits and path.suffix == ".tar", map(Path, names))
        for shard in sorted(shards, key=shard_index):
            lines, size = key_lines(out / shard), (out / shard).stat().st_size
            views = lines.count(b"\n")
            yield f"{shard.parent / KEYS_FILE}/{shard_index(shard) // MAX_SHARD_SCENES}", lines
            yield f"{shard.parent}/{_SIZES}/0", f"{size} {views}\n".encode()

    def places(self, episode: int) -> Iterator[Path]:
        return (path.relative_to(self._out) for scene in self.scene_ids(episode) for path in find_shards(scene, self._folder(scene)))

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        split = self._folder(scenes[0][1]).relative_to(self._out)
        return commit_shards, (scenes, self._out, split, images, tuple(view.layers for view in self._views))


def _write_keys(out: Path, name: str, split: Path, pool: WriterPool, scenes: Sequence[int]) -> SplitContent:
    """Write the index of a split by reading its shards of these scenes. Returns the numbers of views and shards, and their size."""
    parts = out / PARTIAL / ShardsExporter.staging / "keys"
    with output_errors(out / split):
        parts.parent.mkdir(exist_ok=True)
        shutil.rmtree(parts, ignore_errors=True)
        parts.mkdir()
        shards, size = 0, 0
        for shard in (shard for scene in scenes for shard in find_shards(scene, out / split)):
            shards, size = shards + 1, size + shard.stat().st_size
            pool.submit(list_keys, (), (shard, parts), path=shard)
        pool.wait()
        views = sum(path.read_bytes().count(b"\n") for path in _join_keys(parts, out / split))
        return SplitContent(name, split.name, views, shards, size)


def _join_keys(parts: Path, split: Path) -> list[Path]:
    """Write the index of a split by concatenating the files of a folder in numerical order. Returns these files."""
    paths = sorted(parts.iterdir(), key=lambda path: (len(path.name), path.name)) if parts.is_dir() else []
    write_atomically(split / KEYS_FILE, join_lines(paths, b"{", b"}\n"))
    return paths


def _join_known(out: Path, name: str, split: Path) -> SplitContent:
    """Write the index of a split from the `index_lines` of its episodes, without reading shards. Returns as `_write_keys`."""
    known, shards, size, views = out / LINES / split, 0, 0, 0
    with output_errors(out / split):
        _join_keys(known / KEYS_FILE, out / split)
        with (known / _SIZES / "0").open() if (known / _SIZES).is_dir() else contextlib.nullcontext(()) as rows:
            for row in rows:
                own_size, own_views = map(int, row.split())
                shards, size, views = shards + 1, size + own_size, views + own_views
    return SplitContent(name, split.name, views, shards, size)
