"""Forecast of a bake: views, size on disk, memory and time, for `bake --dry-run`."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from synpick_warp.cli.display import format_duration, make_console, make_progress
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.forecast import GB, check_disk, forecast_settings
from synpick_warp.factory.memory_plan import check_memory, plan_memory, split_memories
from synpick_warp.factory.sizes import count_writers, fit_to_device, without_pictures
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.inputs.urls import store_url

_GIB = 1024**3


def print_forecast(config: Config, out: Path | None, episodes: Sequence[int]) -> int:
    """Print what a bake of these episodes is expected to take, and compare it with memory and disk. Nothing is written but shapes' cache.

    Returns:
        Exit code.

    Raises:
        SynpickError: It takes more than there is, or objects cannot be used.
    """
    console = make_console()
    with make_progress(console) as progress:
        device = pick_device(config.bake.device)
        writers = count_writers(config.bake.writers, Needs.of(config).slot_bytes)
        fitted = fit_to_device(without_pictures(config), device, len(episodes), writers)
        terms = plan_memory(fitted, device, writers)
        forecast = forecast_settings(fitted, episodes, progress)
        here = out is None or store_url(out) is None
        folder = next((path for path in (Path(out or ".").absolute(), *Path(out or ".").absolute().parents) if path.is_dir()), Path("/"))
        if here:
            check_disk(forecast, folder, progress)
        check_memory(terms, device)
    table = Table(show_header=False, box=None)
    table.add_row("episodes", f"{forecast.episodes:,}, of some {forecast.frames_of_episode:.0f} frames")
    table.add_row("views", f"about {forecast.views:,}")
    free = f", {shutil.disk_usage(folder).free / GB:,.1f} GB are free" if here else ""
    table.add_row("data set", f"about {forecast.size / GB:,.1f} GB{free}")
    for part, memory in split_memories(terms, device, 1):
        place = device.alias if part[0].on_device else "host"
        table.add_row(f"memory, {place}", f"at least {sum(term.size for term in part) / _GIB:.1f} GiB, {memory / _GIB:.1f} GiB are free")
    table.add_row("worlds", f"{fitted.bake.worlds:,} on {device.alias}")
    table.add_row("time", f"about {format_duration(forecast.gpu_seconds)} on an H100 with 16 cores; on a CPU some hundred times as long")
    console.print(table)
    return 0
