"""Benchmark of a bake without pictures: world-steps per second and episodes per hour of `bake --formats usd,zarr` in steady state.

Such a bake renders no views; worlds that pick still render the images of their perception.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

from synpick_warp.configs.schema import Config, Physics
from synpick_warp.exporters.registry import Exporters
from synpick_warp.factory.order import predict_frames
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.stages.sim.arrange import sample_episodes_ahead
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.views.frames import TickBatch
from tools.bench.meter import LIVE_FRACTION, SteadyMeter, summarize_rates
from tools.bench.steady import SPARE_EPISODES
from tools.options import Row

FORMATS = ("usd", "zarr")
"""Formats without pictures."""
HOUR = 3600.0
"""[s]"""


def measure_trajectories(config: Config, min_seconds: float) -> Iterator[Row]:
    """Bake to the temporary folder (TMPDIR) until the steady state is measured for `min_seconds` [s]; the files are removed."""
    config = config.with_values({"bake.formats": FORMATS, "bake.episodes": SPARE_EPISODES * config.bake.worlds})
    worlds, device = config.bake.worlds, pick_device(config.bake.device)
    with tempfile.TemporaryDirectory() as folder, _count_frames() as frames:
        meter = SteadyMeter(min_seconds, Path(folder), LIVE_FRACTION * worlds, worlds, device, counter=lambda: frames[0])
        summary = run_bake(config, Path(folder) / "out", meter)
    if len(meter.readings) > 1:
        sampled = sample_episodes_ahead(config, load_catalog(config), np.arange(config.bake.episodes, dtype=np.int32), device)
        yield from _summarize(worlds, config.physics, float(np.mean(predict_frames(*sampled))), meter)
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


def _summarize(worlds: int, physics: Physics, mean: float, meter: SteadyMeter) -> Iterator[Row]:
    """Rows: rates, world-steps of all worlds whether live or not, disk space, and episodes, which have `mean` frames."""
    yield Row("worlds", worlds, "")
    yield from summarize_rates("frame", meter)
    first, last = meter.readings[0], meter.readings[-1]
    seconds, ticks, frames = last.time - first.time, len(meter.readings) - 1, last.count - first.count
    rate = ticks * physics.steps_per_tick * worlds / seconds
    yield Row("world-steps", rate, "1/s")
    yield Row("simulated time: multiple of real time", rate * physics.step, "")
    yield Row("worlds with a frame in a tick", 100.0 * frames / (ticks * worlds), "%")
    yield Row("size of a frame on disk", 1e-3 * (last.disk - first.disk) / max(1, frames), "kB")
    yield Row("episodes that ended", last.episodes - first.episodes, "")
    yield Row(f"episodes, if of {mean:.0f} frames as in tools/README.md", HOUR * frames / seconds / mean, "1/h")
