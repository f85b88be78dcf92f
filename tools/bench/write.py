"""Benchmark of the writers: views a second and CPU time by format and number of processes, and the end of a scene."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import ExportContext, Exporter
from synpick_warp.exporters.registry import load_exporter_classes
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.exporters.writing.pool import QUEUE_DEPTH, WriterPool
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.pipeline import Factory
from synpick_warp.stages.stream import TickReport, tick_batch
from tools.bench.physics import Row

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
    # All files stay until the end: to make some soon after others were removed takes longer on some file systems.
    with tempfile.TemporaryDirectory() as folder:
        for name in config.bake.formats:
            yield from _measure_format(name, config, factory, _Given(views, frames), least, Path(folder) / name)


def _measure_format(name: str, config: Config, factory: Factory, given: _Given, least: float, folder: Path) -> Iterator[Row]:
    """Numbers of a format by processes, and the end of episodes with all of them."""
    (kind,) = load_exporter_classes((name,))
    cores = len(os.sched_getaffinity(0))
    written = _Written(0.0, {}, 0.0, 0, 0.0, 0.0, 0.0)
    for processes in sorted({1, *(2**power for power in range(1, cores.bit_length())), cores}):
        written = _write(kind, config, factory, given, processes, least, folder / str(processes))
        label = f"{name}, {processes} process{'es' if processes > 1 else ''}"
        yield Row("write", f"{label}: views", written.rate, "1/s")
        for part, seconds in written.cpu.items():
            yield Row("write", f"{label}: CPU of a view, {part}", 1e3 * seconds, "ms")
        yield Row("write", f"{label}: cores in use", written.rate * sum(written.cpu.values()), "")
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
    cpu: dict[str, float]
    """CPU time of a view, by part [s]."""
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


def _write(kind: type[Exporter], config: Config, factory: Factory, given: _Given, processes: int, least: float, out: Path) -> _Written:
    """Write into a folder that is not there yet, for at least so long [s]."""
    (out / PARTIAL).mkdir(parents=True)
    with WriterPool(processes, kind.slot_bytes(config)) as pool:
        exporter = kind(ExportContext(out, config, factory.catalog, factory.cameras, factory.lights, pool))
        exporter.write_constants()
        for batch in (given.of(COPIES, 0)[0] for _ in range(-(-processes * QUEUE_DEPTH // len(given.views)))):
            exporter.write_views(batch)
        pool.wait()
        cpu, frame, started = _cpu_seconds(pool), 0, time.perf_counter()
        while frame == 0 or (frame < MOST_FRAMES and time.perf_counter() - started < least):
            for copy in range(COPIES):
                views, frames = given.of(copy, frame)
                exporter.write_ticks(frames)
                exporter.write_views(views)
            frame += 1
        pool.wait()
        seconds = time.perf_counter() - started
        # The clocks of a thread and of all are not read at once, so their difference may seem to shrink.
        cpu = {part: max(0.0, spent - cpu[part]) for part, spent in _cpu_seconds(pool).items()}
        episodes = given.episodes()
        for episode in episodes:
            exporter.end_episode(EpisodeEnd(episode, 0, frame, int(Ending.FINISHED)), lambda: None)
        pool.wait()
        finish = time.perf_counter() - started - seconds
        places = [out / path for episode in episodes for path in exporter.files(episode)]
        files = [path for place in places for path in ([place] if place.is_file() else place.rglob("*")) if path.is_file()]
        size = sum(path.stat().st_size for path in files)
        exporter.close()
    count = frame * COPIES * len(given.views)
    cpu = {part: spent / count for part, spent in cpu.items()}
    return _Written(count / seconds, cpu, finish / len(episodes), frame, count / (seconds + finish), len(files) / count, size / count)


def _cpu_seconds(pool: WriterPool) -> dict[str, float]:
    """What this process's thread that hands out views, its others, and the writers have spent, the last by mode [s]."""
    # Of /proc/PID/stat, utime and stime (proc_pid_stat(5)); the name before may hold blanks.
    texts = (Path(f"/proc/{pid}/stat").read_text() for pid in pool.pids())
    ticks = np.array([[int(number) for number in text.rpartition(")")[2].split()[11:13]] for text in texts])
    user, kernel = (ticks.sum(axis=0) / os.sysconf("SC_CLK_TCK")).tolist()
    first = time.thread_time()
    return {"main thread": first, "its other threads": time.process_time() - first, "writers, user": user, "writers, kernel": kernel}
