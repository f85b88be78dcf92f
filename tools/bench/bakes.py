"""Parts that bake to the temporary folder (TMPDIR): the steady state, with and without pictures.

Background processes verify finished episodes and delete their files, so that the disk does not fill.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.schema import Config
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.registry import Exporters, load_exporter_classes, shared_files
from synpick_warp.factory.order import predict_frames
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.factory.sizes import pick_processes
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.stages.sim.arrange import sample_episodes_ahead
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.views.frames import TickBatch
from tools.bench.cleaner import Assignment, Cleaner
from tools.bench.meter import SteadyMeter, summarize_rates
from tools.bench.run import LIVE_FRACTION, SPARE_EPISODES, Bench
from tools.options import MeasuredRow

WITHOUT_PICTURES = ("usd", "zarr")
"""Formats of trajectories alone; worlds that pick still render the images of their perception."""
HOUR = 3600.0
"""[s]"""


@contextlib.contextmanager
def clean_up_behind(layout: DataLayout, out: Path) -> Iterator[Cleaner]:
    """Context manager: verify the episodes of a bake to `out` while it runs, and delete their files.

    Raises:
        DatasetError: An episode was damaged.
    """
    folders = tuple(map(str, shared_files(load_exporter_classes(layout.formats), layout).folders))
    with Cleaner(Assignment(out, folders)) as cleaner:
        yield cleaner
        tally = cleaner.poll()
    if tally.problem:
        raise DatasetError(tally.problem)


def measure_steady(bench: Bench) -> Iterator[MeasuredRow]:
    """Views per second to disk while nearly all worlds are live, and CPU time of a view by kind of process; each device simulates
    `bake.worlds` worlds."""
    config = bench.config
    names = pick_processes(config, bench.devices, INT32_MAX) if bench.devices else ()
    count = max(1, len(names))
    config = config.with_values({"bake.episodes": SPARE_EPISODES * config.bake.worlds * count})
    device = pick_device(names[0] if names else config.bake.device)
    live_views = LIVE_FRACTION * config.bake.worlds * len(config.rig)
    with tempfile.TemporaryDirectory() as folder, clean_up_behind(DataLayout.of(config), Path(folder) / "out") as cleaner:
        meter = SteadyMeter(bench.seconds, Path(folder), live_views, config.bake.worlds, device, cleaner, devices=count)
        summary = run_bake(config, Path(folder) / "out", meter, devices=names)
    if len(meter.readings) > 1:
        yield from _summarize_steady(meter)
    meter.raise_interruption(summary)


def _summarize_steady(meter: SteadyMeter) -> Iterator[MeasuredRow]:
    """Rows of the rates, the verified scenes, and the space on disk."""
    yield from summarize_rates("view", meter)
    first, last = meter.readings[0], meter.readings[-1]
    verified, deleted = last.tally.episodes - first.tally.episodes, last.tally.deleted - first.tally.deleted
    yield MeasuredRow("episodes that ended", last.episodes - first.episodes, "")
    yield MeasuredRow("episodes of which all files are verified and deleted", verified, "")
    yield MeasuredRow("files of these", last.tally.files - first.tally.files, "")
    yield MeasuredRow("errors found in them", int(bool(last.tally.problem)), "")
    yield MeasuredRow("size of a view on disk", 1e-6 * (last.disk + deleted - first.disk) / max(1, last.count - first.count), "MB")
    # Others may delete files of the same file system meanwhile.
    disk = max(meter.initial_disk, *(reading.disk for reading in meter.readings))
    yield MeasuredRow("largest size on disk", 1e-9 * (disk - meter.initial_disk), "GB")


def measure_trajectories(bench: Bench) -> Iterator[MeasuredRow]:
    """World-steps per second and episodes per hour of a bake without pictures in steady state."""
    config = bench.config.with_values({"bake.formats": WITHOUT_PICTURES, "bake.episodes": SPARE_EPISODES * bench.config.bake.worlds})
    worlds = config.bake.worlds
    with tempfile.TemporaryDirectory() as folder, _count_frames() as frames:
        meter = SteadyMeter(bench.seconds, Path(folder), LIVE_FRACTION * worlds, worlds, bench.device, counter=lambda: frames[0])
        summary = run_bake(config, Path(folder) / "out", meter)
    if len(meter.readings) > 1:
        sampled = sample_episodes_ahead(config, load_catalog(config), np.arange(config.bake.episodes, dtype=np.int32), bench.device)
        yield from _summarize_trajectories(config, float(np.mean(predict_frames(*sampled))), meter)
    meter.raise_interruption(summary)


@contextlib.contextmanager
def _count_frames() -> Iterator[list[int]]:
    """Count frames handed to the exporters within this context; yields a list whose one element is the count."""
    frames, write = [0], Exporters.write_ticks

    def count(exporters: Exporters, batch: TickBatch) -> None:
        frames[0] += len(batch)
        write(exporters, batch)

    with mock.patch.object(Exporters, "write_ticks", count):
        yield frames


def _summarize_trajectories(config: Config, mean: float, meter: SteadyMeter) -> Iterator[MeasuredRow]:
    """Rows: rates, world-steps of all worlds whether live or not, disk space, and episodes, which have `mean` frames."""
    worlds, physics = config.bake.worlds, config.physics
    yield MeasuredRow("worlds", worlds, "")
    yield from summarize_rates("frame", meter)
    first, last = meter.readings[0], meter.readings[-1]
    seconds, ticks, frames = last.time - first.time, len(meter.readings) - 1, last.count - first.count
    rate = ticks * physics.steps_per_tick * worlds / seconds
    yield MeasuredRow("world-steps", rate, "1/s")
    yield MeasuredRow("simulated time: multiple of real time", rate * physics.step, "")
    yield MeasuredRow("worlds with a frame in a tick", 100.0 * frames / (ticks * worlds), "%")
    yield MeasuredRow("size of a frame on disk", 1e-3 * (last.disk - first.disk) / max(1, frames), "kB")
    yield MeasuredRow("episodes that ended", last.episodes - first.episodes, "")
    yield MeasuredRow(f"episodes, if of {mean:.0f} frames as in tools/README.md", HOUR * frames / seconds / mean, "1/h")
