"""Contract tests of the exporter interface: determinism, atomic commits, resuming. Test classes of exporters inherit `ExporterContract`."""

import dataclasses
import hashlib
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from synpick_warp.codes import Ending
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Config
from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import ExportContext, Exporter
from synpick_warp.exporters.formats import Format
from synpick_warp.exporters.picks import PicksExporter
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.types import Camera
from synpick_warp.system.codecs.jpeg import encode_jpeg
from synpick_warp.testing import box_views
from synpick_warp.testing.box_views import batches, cameras, catalog, ends, pick_batch, ticks
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch

FRAMES = 3
MOST_EPISODES = 100
LENSES = cameras()
_IDAT = slice(41, -16)
"""Data of a PNG file with one chunk of it: behind signature, header and the chunk's own head, before its checksum and the end."""


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def exporting(
    exporter_class: type[Exporter], out: Path, config: Config, processes: int = 0, lenses: tuple[Camera, ...] = LENSES
) -> Iterator[Exporter]:
    """Create an exporter on a folder prepared as by a bake; afterwards remove partial files, as a bake does."""
    resolution = (lenses[0].width, lenses[0].height)
    config = dataclasses.replace(config, cameras=dataclasses.replace(config.cameras, resolution=resolution))
    (out / PARTIAL).mkdir(parents=True, exist_ok=True)
    with WriterPool(processes, exporter_class.slot_bytes(ExportSettings.of(config))) as pool:
        try:
            yield exporter_class(ExportContext(out, ExportSettings.of(config), catalog(), lenses, skies(), pool))
        finally:
            shutil.rmtree(out / PARTIAL, ignore_errors=True)


def export(
    exporter_class: type[Exporter],
    out: Path,
    config: Config,
    episodes: tuple[int, ...] = (0, 2),
    processes: int = 0,
    frames: int = FRAMES,
    lenses: tuple[Camera, ...] = LENSES,
    prepare: Callable[[FrameBatch], FrameBatch] = lambda batch: batch,
) -> Path:
    """Write a complete data set of boxes, of views changed by `prepare`."""
    with exporting(exporter_class, out, config, processes, lenses) as exporter:
        exporter.write_constants()
        feed(exporter, episodes, frames, prepare=prepare)
        finish(exporter)
    return out


def feed(
    exporter: Exporter,
    episodes: tuple[int, ...],
    frames: int = FRAMES,
    ending: Ending = Ending.FINISHED,
    views: int = 4,
    prepare: Callable[[FrameBatch], FrameBatch] = lambda batch: batch,
) -> list[int]:
    """Feed interleaved episodes in batches whose buffers are overwritten; returns a list to which committed episodes are appended."""
    committed: list[int] = []
    lenses = export_context(exporter).cameras
    views_per_tick = len(lenses) * len(episodes)
    view_batches = [prepare(batch) for batch in batches(views, episodes, frames, lenses)]
    for index, tick in enumerate(ticks(len(episodes), episodes, frames)):
        exporter.write_ticks(tick)
        overwrite(tick)
        first, last = -(-index * views_per_tick // views), -(-(index + 1) * views_per_tick // views)
        for batch in view_batches[first:last]:
            exporter.write_views(batch)
            overwrite(batch)
    for episode in episodes if isinstance(exporter, PicksExporter) else ():
        exporter.write_picks(pick_batch(episode))
    for end in ends(episodes, frames, ending):
        exporter.end_episode(end, lambda index=end.episode: committed.append(index))
    return committed


def with_files(batch: FrameBatch) -> FrameBatch:
    """The batch with JPEG files and data of depth PNGs as a GPU makes them; those of cameras 1 and 2 exceed their capacity."""
    jpeg, jpeg_size = _pad([bytes(encode_jpeg(image, 95)) for image in batch.color], batch.camera == 1)
    idat, idat_size = _pad([encode_png(image)[_IDAT] for image in batch.depth], batch.camera == 2)
    return dataclasses.replace(batch, jpeg=jpeg, jpeg_size=jpeg_size, depth_idat=idat, depth_idat_size=idat_size)


def without_objects(batch: FrameBatch) -> FrameBatch:
    """The batch as views of nothing."""
    return dataclasses.replace(batch, object_id=np.full_like(batch.object_id, -1), instance=np.zeros_like(batch.instance))


def _pad(files: list[bytes], exceeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Files in an array (B, capacity) uint8, and their sizes."""
    capacity = max(map(len, files))
    sizes = np.array([capacity + 1 if flag else len(file) for file, flag in zip(files, exceeds, strict=True)], np.int32)
    return np.stack([np.frombuffer(file.ljust(capacity, b"x"), np.uint8) for file in files]), sizes


def overwrite(batch: FrameBatch | TickBatch) -> None:
    """Overwrite the buffers of a batch, as the bake reuses them."""
    layers = batch.layers.values() if isinstance(batch, FrameBatch) else ()
    for value in (*vars(batch).values(), *layers):
        if isinstance(value, np.ndarray):
            value.fill(7)


def finish(exporter: Exporter) -> list[Path]:
    """End as a bake does: wait, close, write index files."""
    context = export_context(exporter)
    context.pool.wait()
    exporter.close()
    episodes = [index for index in range(MOST_EPISODES) if exporter.files(index)]
    return exporter.finalize(context.out, context.settings, context.pool, episodes)


def export_context(exporter: Exporter) -> ExportContext:
    """The exporter's constructor argument; every exporter keeps it under this name."""
    return exporter._context  # type: ignore[attr-defined]


def expand(out: Path, paths: list[Path]) -> set[str]:
    """Expand files and folders into the files they hold."""
    files = set()
    for path in paths:
        assert not path.is_absolute()
        inside = [out / path] if (out / path).is_file() else [file for file in (out / path).rglob("*") if file.is_file()]
        assert inside, path
        files |= {str(file.relative_to(out)) for file in inside}
    return files


class ExporterContract:
    """Inherit, and set `exporter_class` and `row`."""

    exporter_class: ClassVar[type[Exporter]]
    row: ClassVar[Format | None] = None
    """Row of the format, whose regular expressions must match the files; None: not compared."""

    @classmethod
    def config(cls) -> Config:
        """Settings under test."""
        return box_views.config()

    @pytest.fixture(scope="class")
    @classmethod
    def reference(cls, tmp_path_factory) -> dict[str, str]:
        """SHA-256 of the files of a data set of episodes 0 and 2."""
        return digests(export(cls.exporter_class, tmp_path_factory.mktemp("contract") / "set", cls.config()))

    @pytest.mark.parametrize("processes", [0, 2])
    def test_bytes_do_not_depend_on_process_count_or_order_of_episodes(self, tmp_path, reference, processes):
        with exporting(self.exporter_class, tmp_path, self.config(), processes) as exporter:
            exporter.write_constants()
            for episode in (2, 0):
                feed(exporter, (episode,), views=1 + processes)
            finish(exporter)
        assert digests(tmp_path) == reference

    def test_every_file_belongs_to_constants_or_one_episode_or_index_files(self, tmp_path, reference):
        with exporting(self.exporter_class, tmp_path, self.config()) as exporter:
            constants = expand(tmp_path, exporter.write_constants())
            committed = feed(exporter, (0, 2))
            export_context(exporter).pool.wait()
            assert sorted(committed) == [0, 2]
            first, none, second = (exporter.files(episode) for episode in (0, 1, 2))
            assert none == []
            for files in (first, second):
                assert files == sorted(files) != []
            index_files = expand(tmp_path, finish(exporter))
            parts = [constants, expand(tmp_path, first), expand(tmp_path, second), index_files]
        if self.row is not None:
            layout = DataLayout.of(self.config())
            patterns = (self.row.constants, self.row.episode(layout, 0), self.row.episode(layout, 2))
            for pattern, names in zip(patterns, parts, strict=False):
                assert [name for name in names if not re.fullmatch(pattern, name)] == [], pattern
        assert set().union(*parts) == set(reference)
        assert sum(map(len, parts)) == len(reference)

    def test_discarded_arrangements_leave_no_files(self, tmp_path, reference):
        with exporting(self.exporter_class, tmp_path, self.config(), 1) as exporter:
            exporter.write_constants()
            discarded = feed(exporter, (0, 2), frames=2, ending=Ending.NOT_FINITE)
            without_frames: list[int] = []
            exporter.end_episode(EpisodeEnd(2, 1, 0, int(Ending.UNSETTLED)), lambda: without_frames.append(2))
            feed(exporter, (0, 2))
            finish(exporter)
        assert (sorted(discarded), without_frames) == ([0, 2], [2])
        assert digests(tmp_path) == reference

    def test_episodes_appear_only_when_committed(self, tmp_path, reference):
        with exporting(self.exporter_class, tmp_path, self.config(), 1) as exporter:
            exporter.write_constants()
            committed = feed(exporter, (0,))
            for batch in batches(4, (2,), 2, LENSES):
                exporter.write_views(batch)
            for tick in ticks(1, (2,), 2):
                exporter.write_ticks(tick)
            export_context(exporter).pool.wait()
            assert committed == [0]
            assert exporter.files(2) == []
            export_context(exporter).pool.abort()
            exporter.abort()
        kept = digests(tmp_path)
        assert kept.items() <= reference.items()

    def test_removed_episode_is_rewritten_identically(self, tmp_path, reference):
        export(self.exporter_class, tmp_path, self.config())
        with exporting(self.exporter_class, tmp_path, self.config()) as exporter:
            exporter.write_constants()
            for path in exporter.files(2):
                shutil.rmtree(tmp_path / path) if (tmp_path / path).is_dir() else (tmp_path / path).unlink()
            feed(exporter, (2,))
            finish(exporter)
        assert digests(tmp_path) == reference

    @pytest.mark.parametrize("processes", [0, 1])
    def test_removed_data_set_is_an_error_and_not_recreated(self, tmp_path, processes):
        out = tmp_path / "set"
        with exporting(self.exporter_class, out, self.config(), processes) as exporter:
            exporter.write_constants()
            shutil.rmtree(out)
            with pytest.raises(OutputError):
                _feed_and_wait(exporter)
            export_context(exporter).pool.abort()
            exporter.abort()
        assert not out.exists()


def _feed_and_wait(exporter: Exporter) -> None:
    feed(exporter, (0, 2))
    export_context(exporter).pool.wait()
