"""Machine report (versions, CPU, device, caches, memory plan, verdict), and forecast of a bake (views, disk, memory, time)."""

import contextlib
import importlib.metadata
import os
import platform
import shutil
from collections.abc import Sequence
from pathlib import Path

import warp as wp
from rich.table import Table

from synpick_warp._version import __version__
from synpick_warp.cli.display import format_duration, make_console, make_progress
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError, DeviceError
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.episodes import count_writers
from synpick_warp.factory.forecast import GB, check_disk, forecast_settings
from synpick_warp.factory.memory_plan import check_memory, fit_to_device, plan_memory, split_memories, without_pictures
from synpick_warp.scenes.collision.shapes import default_cache_dir
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.hardware.device import SmPartition, count_reserved, pick_device
from synpick_warp.system.hardware.kernels import KERNEL_VARIABLE, USER_VARIABLE, find_fault
from synpick_warp.system.inputs.urls import store_url

_PACKAGES = ("warp-lang", "newton", "numpy")
_SMALL = 1e-3
"""Share of the plan below which an array has no row of its own."""
MIB = 1024**2
GIB = 1024**3


def print_report(config: Config, with_arrays: bool) -> None:
    """Print device, versions and caches, with `with_arrays` the memory plan of a bake with these settings, and the verdict."""
    device = pick_device(config.bake.device)
    table, caches = Table(show_header=False, box=None), _caches()
    for name, value in [*describe_machine(device), *(row[:2] for row in caches)]:
        table.add_row(name, value)
    console = make_console()
    console.print(table)
    if with_arrays:
        console.print(memory_report(config))
    faults = [f"the {name} cannot be written ({fault})" for name, _, fault in caches if fault]
    try:
        check_memory(plan_memory(config, device), device)
    except ConfigError as error:
        faults.append(str(error))
    ready = f"ready: bakes with these settings run on {device.alias}"
    slow = "" if device.is_cuda else ", some hundred times as slow as on a GPU, none of which was found"
    console.print(f"verdict: {'; '.join(faults) or ready + slow}", markup=False, soft_wrap=True)


def describe_machine(device: wp.Device) -> list[tuple[str, str]]:
    """Rows (name, value) of versions, CPU, memory and device, to be quoted with measurements."""
    rows = [("synpick-warp", __version__), ("python", f"{platform.python_version()} on {platform.platform()}")]
    rows += [(name, importlib.metadata.version(name)) for name in _PACKAGES]
    rows.append(("CPU cores", f"{count_cores()} usable of {os.cpu_count()}"))
    if hasattr(os, "sysconf"):
        rows.append(("memory", f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / GIB:.1f} GiB"))
    rows.append(("device", f"{device.alias}: {device.name}"))
    if device.is_cuda:
        rows.append(("device memory", f"{device.free_memory / GIB:.1f} of {device.total_memory / GIB:.1f} GiB free"))
        rows.append(("compute capability", f"{device.arch / 10:.1f}"))
        rows.append(("multiprocessors", f"{device.sm_count}, {_describe_partition(device)}"))
    toolkit = wp.get_cuda_toolkit_version()
    driver = wp.get_cuda_driver_version() if wp.is_cuda_available() else None
    return [*rows, ("CUDA", f"driver {_dotted(driver)}, Warp built with {_dotted(toolkit)}")]


def memory_report(config: Config) -> Table:
    """Table of shape, unit and size of the arrays in the memory plan of a bake with these settings, and their sum. Small arrays, of less
    than `_SMALL` of it, share a row."""
    device, episodes = pick_device(config.bake.device), DataLayout.of(config).planned
    writers = count_writers(config.bake.writers, Needs.of(config).slot_bytes)
    config = fit_to_device(without_pictures(config), device, episodes, writers)
    rows = [row for term in plan_memory(config, device) for row in term.rows]
    size = ", ".join(dict.fromkeys(f"{width}x{height}" for width, height in config.rig.sizes))
    table = Table("array", "shape", "unit", "MiB", title=f"{config.bake.worlds} worlds, {size}", show_footer=True)
    table.columns[3].justify = "right"
    total = sum(row[3] for row in rows)
    small = [row[3] for row in rows if row[3] < _SMALL * total]
    for name, shape, unit, size in sorted(rows, key=lambda row: -row[3])[: len(rows) - len(small)]:
        table.add_row(name, " x ".join(map(str, shape)), unit, f"{size / MIB:.2f}")
    table.add_row(f"smaller arrays: {len(small)}", "", "", f"{sum(small) / MIB:.2f}")
    table.columns[0].footer = "the whole plan"
    table.columns[3].footer = f"{total / MIB:.2f}"
    return table


def _describe_partition(device: wp.Device) -> str:
    """How many multiprocessors of a GPU a bake can reserve for physics, or why none."""
    from synpick_warp.stages.ticks import PHYSICS_SHARE

    try:
        partition = SmPartition(device, count_reserved(device, PHYSICS_SHARE))
        partition.make_stream(on_reserved=True)
    except DeviceError as error:
        return f"none of which can be reserved for physics ({error})"
    return f"{partition.reserved} of which can be reserved for physics"


def _caches() -> list[tuple[str, str, str | None]]:
    """Rows (name, value, fault) of the kernel cache and the shape cache: folder, content, its variable; why it cannot be written."""
    kernels, shapes = Path(wp.config.kernel_cache_dir or ""), default_cache_dir()
    return [
        ("kernel cache", f"{kernels}: {_describe_folder(kernels, 'modules')}; {KERNEL_VARIABLE} moves it", find_fault(kernels)),
        ("shape cache", f"{shapes}: {_describe_folder(shapes, 'shapes')}; {USER_VARIABLE} moves it", find_fault(shapes)),
    ]


def _describe_folder(folder: Path, noun: str) -> str:
    size, entries = 0, 0
    for parent, folders, names in os.walk(folder):  # Unlike rglob, it passes over folders that another process renames meanwhile.
        entries += (len(folders) + len(names)) if parent == str(folder) else 0
        for name in names:
            with contextlib.suppress(OSError):
                size += os.stat(os.path.join(parent, name)).st_size
    return f"{entries} {noun}, {size / MIB:.0f} MiB"


def _dotted(version: tuple[int, int] | None) -> str:
    """Version as text with dots; None: "not found"."""
    return "not found" if version is None else ".".join(map(str, version))


def print_forecast(config: Config, out: Path | None, episodes: Sequence[int]) -> int:
    """Print what a bake of these episodes is expected to take, and compare it with memory and disk; returns the exit code. Nothing is
    written but shapes' cache. Raises SynpickError if it takes more than there is, or objects cannot be used."""
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
        table.add_row(f"memory, {place}", f"at least {sum(term.size for term in part) / GIB:.1f} GiB, {memory / GIB:.1f} GiB are free")
    table.add_row("worlds", f"{fitted.bake.worlds:,} on {device.alias}")
    table.add_row("time", f"about {format_duration(forecast.gpu_seconds)} on an H100 with 16 cores; on a CPU some hundred times as long")
    console.print(table)
    return 0
