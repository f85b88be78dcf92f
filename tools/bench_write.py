"""What tools/bench.py measures of the writers: views a second by format and number of processes, and what the end of a scene takes."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_physics import Row

from synpick_warp.bake import Factory
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import DataSet, Exporter
from synpick_warp.exporters.files import PARTIAL
from synpick_warp.exporters.pool import WriterPool
from synpick_warp.exporters.registry import exporter_kinds
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.outcome import Ending
from synpick_warp.stages.stream import TickReport, tick_batch

COPIES = 8
"""Of their episodes, so that files spread over as many folders as those of many worlds do."""
MOST_FRAMES = 600
"""Of an episode, as long as those of picking are; formats without pictures write them in no time."""


@dataclass(frozen=True)
class _Given:
    """What the writers get: the views and the frames of the same worlds."""

    views: FrameBatch
    frames: TickBatch

    def of(self, copy: int, frame: int) -> tuple[FrameBatch, TickBatch]:
        """The same as a frame of other episodes."""
        return tuple(  # type: ignore[return-value]
            dataclasses.replace(batch, episode=self._episodes(batch.episode, copy), frame=np.full(len(batch.episode), frame, np.int32))
            for batch in (self.views, self.frames)
        )

    def episodes(self) -> list[int]:
        """All episodes that come."""
        return sorted({int(number) for copy in range(COPIES) for number in self._episodes(self.frames.episode, copy)})

    @staticmethod
    def _episodes(episode: np.ndarray, copy: int) -> np.ndarray:
        return ((COPIES + 1) * episode + copy).astype(np.int32)


def measure_writing(config: Config, factory: Factory, report: TickReport, least: float) -> Iterator[Row]:
    """Rates of each format alone. `report` says which worlds are in the views; `least` is the time a measurement takes at least [s]."""
    snapshot = factory.simulation.records[0].snapshot
    kept = [_copied(batch) for batch in factory.stream.render(snapshot, report)]
    layers = {name: np.concatenate([batch.layers[name] for batch in kept]) for name in kept[0].layers}
    names = [name for name, array in vars(kept[0]).items() if isinstance(array, np.ndarray)]
    views = FrameBatch(**{name: np.concatenate([getattr(batch, name) for batch in kept]) for name in names}, layers=layers)
    frames = tick_batch(report, factory.log.object_ids, config.physics.step * config.physics.steps_per_tick)
    yield Row("write", "objects in a view", float((views.object_id >= 0).sum(axis=1).mean()), "")
    cores = len(os.sched_getaffinity(0))
    for name in config.bake.formats:
        (kind,) = exporter_kinds((name,))
        written = _Written(0.0, 0.0, 0, 0.0, 0.0, 0.0)
        for processes in sorted({1, *(2**power for power in range(1, cores.bit_length())), cores}):
            written = _write(kind, config, factory, _Given(views, frames), processes, least)
            yield Row("write", f"{name}: views, {processes} process{'es' if processes > 1 else ''}", written.rate, "1/s")
        yield Row("write", f"{name}: an episode, to finish", 1e3 * written.finish, "ms")
        yield Row("write", f"{name}: views, with the end of episodes of {written.frames} frames", written.whole_rate, "1/s")
        yield Row("write", f"{name}: files of a view", written.files, "")
        yield Row("write", f"{name}: files of a view", 1e-6 * written.size, "MB")


def _copied(batch: FrameBatch) -> FrameBatch:
    arrays = {name: array.copy() for name, array in vars(batch).items() if isinstance(array, np.ndarray)}
    return dataclasses.replace(batch, **arrays, layers={name: array.copy() for name, array in batch.layers.items()})


@dataclass(frozen=True)
class _Written:
    """What a number of processes did with a format."""

    rate: float
    """Views written [1/s]."""
    finish: float
    """Time from the last view to whole episodes, divided by their number [s]."""
    frames: int
    """Of an episode."""
    whole_rate: float
    """Views from the first to whole episodes [1/s]."""
    files: float
    """Files of a view, in whole episodes."""
    size: float
    """Their size [B]."""


def _write(kind: type[Exporter], config: Config, factory: Factory, given: _Given, processes: int, least: float) -> _Written:
    with tempfile.TemporaryDirectory() as folder, WriterPool(processes, kind.slot_bytes(config)) as pool:
        out = Path(folder)
        (out / PARTIAL).mkdir()
        exporter = kind(DataSet(out, config, factory.catalog, factory.cameras, factory.lights, pool))
        exporter.write_constants()
        for batch in (given.of(COPIES, 0)[0] for _ in range(-(-processes // len(given.views)))):
            exporter.write(batch)
        pool.wait()
        frame, started = 0, time.perf_counter()
        while frame == 0 or (frame < MOST_FRAMES and time.perf_counter() - started < least):
            for copy in range(COPIES):
                views, frames = given.of(copy, frame)
                exporter.tick(frames)
                exporter.write(views)
            frame += 1
        pool.wait()
        seconds = time.perf_counter() - started
        episodes = given.episodes()
        for episode in episodes:
            exporter.end(EpisodeEnd(episode, 0, frame, int(Ending.FINISHED)), lambda: None)
        pool.wait()
        finish = time.perf_counter() - started - seconds
        places = [out / path for episode in episodes for path in exporter.files(episode)]
        files = [path for place in places for path in ([place] if place.is_file() else place.rglob("*")) if path.is_file()]
        size = sum(path.stat().st_size for path in files)
        exporter.close()
    count = frame * COPIES * len(given.views)
    return _Written(count / seconds, finish / len(episodes), frame, count / (seconds + finish), len(files) / count, size / count)
