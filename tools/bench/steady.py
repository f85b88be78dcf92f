"""Steady-state benchmark of a bake: views per second to disk while nearly all worlds are live, and CPU time of a view by kind of process.

Background processes verify finished episodes and delete their files, so that the disk does not fill.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.schema import Config
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.registry import load_exporter_classes, shared_files
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.factory.sizes import pick_processes
from synpick_warp.system.hardware.device import pick_device
from tools.bench.cleaner import Assignment, Cleaner
from tools.bench.meter import LIVE_FRACTION, SteadyMeter, summarize_rates
from tools.options import Row

SPARE_EPISODES = 16
"""Episodes planned for each world, so that none runs out of them in the measurement."""


@contextlib.contextmanager
def clean_up_behind(layout: DataLayout, out: Path, suffixes: tuple[str, ...] = ()) -> Iterator[Cleaner]:
    """Context manager: verify the episodes of a bake to `out` while it runs, and delete their files with these suffixes (empty: all).

    Raises:
        DatasetError: An episode was damaged.
    """
    folders = tuple(map(str, shared_files(load_exporter_classes(layout.formats), layout).folders))
    with Cleaner(Assignment(out, folders, suffixes)) as cleaner:
        yield cleaner
        tally = cleaner.poll()
    if tally.problem:
        raise DatasetError(tally.problem)


def measure_steady(config: Config, min_seconds: float, devices: Sequence[str] = ()) -> Iterator[Row]:
    """Bake to the temporary folder (TMPDIR) until the steady state is measured; the files are removed.

    Args:
        config: All settings; each device simulates `bake.worlds` worlds.
        min_seconds: Time to measure [s].
        devices: Devices with a process each, see `run_bake`; empty: `bake.device` alone.
    """
    names = pick_processes(config, devices, INT32_MAX) if devices else ()
    count = max(1, len(names))
    config = config.with_values({"bake.episodes": SPARE_EPISODES * config.bake.worlds * count})
    device = pick_device(names[0] if names else config.bake.device)
    live_views = LIVE_FRACTION * config.bake.worlds * len(config.rig)
    with tempfile.TemporaryDirectory() as folder, clean_up_behind(DataLayout.of(config), Path(folder) / "out") as cleaner:
        meter = SteadyMeter(min_seconds, Path(folder), live_views, config.bake.worlds, device, cleaner, devices=count)
        summary = run_bake(config, Path(folder) / "out", meter, devices=names)
    if len(meter.readings) > 1:
        yield from _summarize(meter)
    meter.raise_interruption(summary)


def _summarize(meter: SteadyMeter) -> Iterator[Row]:
    """Rows of the rates, the verified scenes, and the space on disk."""
    yield from summarize_rates("view", meter)
    first, last = meter.readings[0], meter.readings[-1]
    verified, deleted = last.tally.episodes - first.tally.episodes, last.tally.deleted - first.tally.deleted
    yield Row("episodes that ended", last.episodes - first.episodes, "")
    yield Row("episodes of which all files are verified and deleted", verified, "")
    yield Row("files of these", last.tally.files - first.tally.files, "")
    yield Row("errors found in them", int(bool(last.tally.problem)), "")
    yield Row("size of a view on disk", 1e-6 * (last.disk + deleted - first.disk) / max(1, last.count - first.count), "MB")
    # Others may delete files of the same file system meanwhile.
    disk = max(meter.initial_disk, *(reading.disk for reading in meter.readings))
    yield Row("largest size on disk", 1e-9 * (disk - meter.initial_disk), "GB")
