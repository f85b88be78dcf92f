"""Benchmark of the writers: views per second and CPU time by format and process count, and the time to finish episodes."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.exporters.base import ExportContext, Exporter
from synpick_warp.exporters.registry import load_exporter_classes
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.exporters.writing.pool import QUEUE_DEPTH, WriterPool
from synpick_warp.factory.assembly import Factory
from synpick_warp.stages.host_copies import DeviceImages
from synpick_warp.stages.stream import TickReport, tick_batch
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch
from tools.bench.meter import Usage, measure_usage
from tools.options import Row

COPIES = 8
"""Episodes written for each given one, so that files spread over as many folders as those of many worlds."""
MAX_FRAMES = 600
"""Frames of an episode, at most: the length of picking episodes. It bounds formats without images, which write fast."""


@dataclass(frozen=True)
class _Input:
    """Input of the writers: views and ticks of the same worlds, reused for every copy and frame."""

    views: FrameBatch
    frames: TickBatch

    def at(self, copy: int, frame: int) -> tuple[FrameBatch, TickBatch]:
        """Views and frames relabelled as frame `frame` of the episodes of copy `copy`."""
        return tuple(  # type: ignore[return-value]
            dataclasses.replace(batch, episode=self._episodes(batch.episode, copy), frame=np.full(len(batch.episode), frame, np.int32))
            for batch in (self.views, self.frames)
        )

    def episodes(self) -> list[int]:
        """Indices of all episodes of all copies, sorted."""
        return sorted({int(index) for copy in range(COPIES) for index in self._episodes(self.frames.episode, copy)})

    @staticmethod
    def _episodes(episode: np.ndarray, copy: int) -> np.ndarray:
        """Indices (int32) of a copy of these episodes, different for each copy."""
        return ((COPIES + 1) * episode + copy).astype(np.int32)


def measure_writing(factory: Factory, report: TickReport, min_seconds: float) -> Iterator[Row]:
    """Benchmark of each format of the settings alone, for at least `min_seconds` [s] each; `report`: selects the worlds whose views are
    written.
    """
    config, snapshot = factory.config, factory.simulation.record.snapshot
    batches = [_copy(batch) for batch in factory.stream.render(snapshot, report)]
    layers = {name: np.concatenate([batch.layers[name] for batch in batches]) for name in batches[0].layers}
    names = [name for name, array in vars(batches[0]).items() if isinstance(array, np.ndarray)]
    views = FrameBatch(**{name: np.concatenate([getattr(batch, name) for batch in batches]) for name in names}, layers=layers)
    frames = tick_batch(report, factory.object_ids, factory.tick_time)
    yield Row("objects per view", float((views.object_id >= 0).sum(axis=1).mean()), "")
    # Files are kept until the end: some file systems create files more slowly after many deletions.
    with tempfile.TemporaryDirectory() as folder:
        for name in config.bake.formats:
            yield from _measure_format(name, factory, _Input(views, frames), min_seconds, Path(folder) / name)


def _measure_format(name: str, factory: Factory, source: _Input, min_seconds: float, folder: Path) -> Iterator[Row]:
    """Benchmark of one format for 1, 2, 4, ... processes up to one per core; finishing episodes is measured with the last count."""
    (exporter_class,) = load_exporter_classes((name,))
    cores = count_cores()
    result = _Result(0.0, {}, 0.0, 0, 0.0, 0.0, 0.0)
    for processes in sorted({1, *(2**power for power in range(1, cores.bit_length())), cores}):
        result = _write(exporter_class, factory, source, processes, min_seconds, folder / str(processes))
        label = f"{name}, {processes} process{'es' if processes > 1 else ''}"
        yield Row(f"{label}: views", result.rate, "1/s")
        for part, seconds in result.cpu.items():
            yield Row(f"{label}: CPU time per view, {part}", 1e3 * seconds, "ms")
        yield Row(f"{label}: cores in use", result.rate * sum(result.cpu.values()), "")
    yield Row(f"{name}: time to finish an episode", 1e3 * result.finish, "ms")
    yield Row(f"{name}: views, including finishing episodes of {result.frames} frames", result.committed_rate, "1/s")
    yield Row(f"{name}: files per view", result.files, "")
    yield Row(f"{name}: size of files per view", 1e-6 * result.size, "MB")


def _copy(batch: FrameBatch) -> FrameBatch:
    """Deep copy of a batch, whose arrays the stream would overwrite, with the images that stay on the device."""
    arrays = {name: array.copy() for name, array in vars(batch).items() if isinstance(array, np.ndarray)}
    for name, images in vars(batch).items():
        if isinstance(images, DeviceImages):
            arrays[name] = np.stack([images[view] for view in range(len(batch))])
    return dataclasses.replace(batch, **arrays, layers={name: array.copy() for name, array in batch.layers.items()})


@dataclass(frozen=True)
class _Result:
    """Result of one format with one process count."""

    rate: float
    """Views written [1/s]."""
    cpu: dict[str, float]
    """CPU time per view, by thread or process group [s]."""
    finish: float
    """Time from the last view until all episodes are committed, per episode [s]."""
    frames: int
    """Frames of each episode."""
    committed_rate: float
    """Views per second until all episodes are committed [1/s]."""
    files: float
    """Files per view, in committed episodes."""
    size: float
    """Size of files per view [B]."""


def _write(exporter_class: type[Exporter], factory: Factory, source: _Input, processes: int, min_seconds: float, out: Path) -> _Result:
    """Write into the new folder `out` for at least `min_seconds` [s], or until episodes have `MAX_FRAMES` frames; returns the measured
    values.
    """
    (out / PARTIAL).mkdir(parents=True)
    settings = ExportSettings.of(factory.config)
    with WriterPool(processes, exporter_class.slot_bytes(settings)) as pool:
        exporter = exporter_class(ExportContext(out, settings, factory.catalog, factory.cameras, factory.lights, pool))
        exporter.write_constants()
        for _ in range(-(-processes * QUEUE_DEPTH // len(source.views))):
            exporter.write_views(source.at(COPIES, 0)[0])
        pool.wait()
        cpu, frame, started = _cpu_seconds(pool), 0, time.perf_counter()
        while frame == 0 or (frame < MAX_FRAMES and time.perf_counter() - started < min_seconds):
            for copy in range(COPIES):
                views, frames = source.at(copy, frame)
                exporter.write_ticks(frames)
                exporter.write_views(views)
            frame += 1
        pool.wait()
        seconds = time.perf_counter() - started
        # Clocks are read one after the other, so their difference may shrink.
        cpu = {part: max(0.0, spent - cpu[part]) for part, spent in _cpu_seconds(pool).items()}
        episodes = source.episodes()
        for episode in episodes:
            exporter.end_episode(EpisodeEnd(episode, 0, frame, int(Ending.FINISHED)), lambda: None)
        pool.wait()
        finish = time.perf_counter() - started - seconds
        paths = [out / path for episode in episodes for path in exporter.files(episode)]
        files = [path for entry in paths for path in ([entry] if entry.is_file() else entry.rglob("*")) if path.is_file()]
        size = sum(path.stat().st_size for path in files)
        exporter.close()
    count = frame * COPIES * len(source.views)
    cpu = {part: spent / count for part, spent in cpu.items()}
    return _Result(count / seconds, cpu, finish / len(episodes), frame, count / (seconds + finish), len(files) / count, size / count)


def _cpu_seconds(pool: WriterPool) -> dict[str, float]:
    """CPU time [s] used so far by this process's main thread, by its other threads, and by the writers in user and kernel mode."""
    usages = measure_usage()
    writers = reduce(Usage.plus, (usages[pid] for pid in pool.pids()))
    main, process = time.thread_time(), time.process_time()
    return {"main thread": main, "other threads": process - main, "writers, user": writers.user, "writers, kernel": writers.system}
