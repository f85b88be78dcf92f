"""What every exporter must do, whatever it writes: test classes of exporters inherit `ExporterContract`."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config
from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import ExportContext, Exporter
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.types import Camera
from tests.worlds import box_views
from tests.worlds.box_views import batches, cameras, catalog, ends, ticks

FRAMES = 3
LENSES = cameras()


def digests(folder: Path) -> dict[str, str]:
    """Digest of every file below a folder."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def exporting(
    kind: type[Exporter], out: Path, config: Config, processes: int = 2, lenses: tuple[Camera, ...] = LENSES
) -> Iterator[Exporter]:
    """An exporter of a folder as a bake prepares it; afterwards what was not whole is gone, as after a bake."""
    resolution = (lenses[0].width, lenses[0].height)
    config = dataclasses.replace(config, cameras=dataclasses.replace(config.cameras, resolution=resolution))
    (out / PARTIAL).mkdir(parents=True, exist_ok=True)
    with WriterPool(processes, kind.slot_bytes(config)) as pool:
        try:
            yield kind(ExportContext(out, config, catalog(), lenses, skies(), pool))
        finally:
            shutil.rmtree(out / PARTIAL, ignore_errors=True)


def export(
    kind: type[Exporter],
    out: Path,
    config: Config,
    episodes: tuple[int, ...] = (0, 2),
    processes: int = 2,
    frames: int = FRAMES,
    lenses: tuple[Camera, ...] = LENSES,
) -> Path:
    """A finished data set of boxes."""
    with exporting(kind, out, config, processes, lenses) as exporter:
        exporter.write_constants()
        feed(exporter, episodes, frames)
        finish(exporter)
    return out


def feed(
    exporter: Exporter, episodes: tuple[int, ...], frames: int = FRAMES, ending: Ending = Ending.FINISHED, views: int = 4
) -> list[int]:
    """Episodes side by side, in batches whose buffers are used again; returns a list to which each whole episode will be added."""
    whole: list[int] = []
    lenses = export_context(exporter).cameras
    room = len(lenses) * len(episodes)
    given = list(batches(views, episodes, frames, lenses))
    for number, tick in enumerate(ticks(len(episodes), episodes, frames)):
        exporter.write_ticks(tick)
        wipe(tick)
        first, last = -(-number * room // views), -(-(number + 1) * room // views)
        for batch in given[first:last]:
            exporter.write_views(batch)
            wipe(batch)
    for end in ends(episodes, frames, ending):
        exporter.end_episode(end, lambda number=end.episode: whole.append(number))
    return whole


def wipe(batch: FrameBatch | TickBatch) -> None:
    """The buffers behind a batch are used for something else."""
    layers = batch.layers.values() if isinstance(batch, FrameBatch) else ()
    for value in (*vars(batch).values(), *layers):
        if isinstance(value, np.ndarray):
            value.fill(7)


def finish(exporter: Exporter) -> list[Path]:
    """As a bake ends: wait, close, join."""
    context = export_context(exporter)
    context.pool.wait()
    exporter.close()
    return exporter.finalize(context.out, context.config, context.pool)


def export_context(exporter: Exporter) -> ExportContext:
    """Every exporter keeps what it was given under this name."""
    return exporter._context  # type: ignore[attr-defined]


def below(out: Path, paths: list[Path]) -> set[str]:
    """Files that these files and folders are or hold."""
    found = set()
    for path in paths:
        assert not path.is_absolute()
        inside = [out / path] if (out / path).is_file() else [one for one in (out / path).rglob("*") if one.is_file()]
        assert inside, path
        found |= {str(one.relative_to(out)) for one in inside}
    return found


class ExporterContract:
    """Inherit, and name the class under test in `kind`."""

    kind: ClassVar[type[Exporter]]

    @classmethod
    def config(cls) -> Config:
        """Settings under test."""
        return box_views.config()

    @pytest.fixture(scope="class")
    @classmethod
    def reference(cls, tmp_path_factory) -> dict[str, str]:
        """Digests of a data set of episodes 0 and 2."""
        return digests(export(cls.kind, tmp_path_factory.mktemp("contract") / "set", cls.config()))

    @pytest.mark.parametrize("processes", [0, 1])
    def test_neither_the_number_of_processes_nor_the_order_changes_a_byte(self, tmp_path, reference, processes):
        with exporting(self.kind, tmp_path, self.config(), processes) as exporter:
            exporter.write_constants()
            for episode in (2, 0):
                feed(exporter, (episode,), views=1 + processes)
            finish(exporter)
        assert digests(tmp_path) == reference

    def test_every_file_is_a_constant_or_an_episodes_or_joined(self, tmp_path, reference):
        with exporting(self.kind, tmp_path, self.config()) as exporter:
            constants = below(tmp_path, exporter.write_constants())
            whole = feed(exporter, (0, 2))
            export_context(exporter).pool.wait()
            assert sorted(whole) == [0, 2]
            first, none, second = (exporter.files(episode) for episode in (0, 1, 2))
            assert none == []
            for files in (first, second):
                assert files == sorted(files) != []
            joined = below(tmp_path, finish(exporter))
            parts = [constants, below(tmp_path, first), below(tmp_path, second), joined]
        assert set().union(*parts) == set(reference)
        assert sum(map(len, parts)) == len(reference)

    def test_an_arrangement_that_is_drawn_again_leaves_nothing(self, tmp_path, reference):
        with exporting(self.kind, tmp_path, self.config()) as exporter:
            exporter.write_constants()
            dropped = feed(exporter, (0, 2), frames=2, ending=Ending.NOT_FINITE)
            unseen: list[int] = []
            exporter.end_episode(EpisodeEnd(2, 1, 0, int(Ending.UNSETTLED)), lambda: unseen.append(2))
            feed(exporter, (0, 2))
            finish(exporter)
        assert (sorted(dropped), unseen) == ([0, 2], [2])
        assert digests(tmp_path) == reference

    def test_an_episode_is_in_its_place_only_when_it_is_whole(self, tmp_path, reference):
        with exporting(self.kind, tmp_path, self.config()) as exporter:
            exporter.write_constants()
            whole = feed(exporter, (0,))
            for batch in batches(4, (2,), 2, LENSES):
                exporter.write_views(batch)
            for tick in ticks(1, (2,), 2):
                exporter.write_ticks(tick)
            export_context(exporter).pool.wait()
            assert whole == [0]
            assert exporter.files(2) == []
            export_context(exporter).pool.abort()
            exporter.abort()
        kept = digests(tmp_path)
        assert kept.items() <= reference.items()

    def test_what_a_killed_bake_left_is_written_again(self, tmp_path, reference):
        export(self.kind, tmp_path, self.config())
        with exporting(self.kind, tmp_path, self.config()) as exporter:
            exporter.write_constants()
            for path in exporter.files(2):
                shutil.rmtree(tmp_path / path) if (tmp_path / path).is_dir() else (tmp_path / path).unlink()
            feed(exporter, (2,))
            finish(exporter)
        assert digests(tmp_path) == reference

    @pytest.mark.parametrize("processes", [0, 2])
    def test_a_data_set_that_vanishes_is_an_error_and_not_made_again(self, tmp_path, processes):
        out = tmp_path / "set"
        with exporting(self.kind, out, self.config(), processes) as exporter:
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
