"""Measure how fast a bake's parts are on this machine: physics, seeing and planning, rendering, writing, and a whole small bake.

Everything is warmed up first; numbers are medians of repeated, synchronised measurements. Physics, sight and rendering use the same
worlds, which pick; with `--set bake.mode=move` they are stirred. Writing gets views of them over and over. Files go to the system's
temporary folder (TMPDIR) and are removed. The part sensor renders the same views by Newton's SensorCamera, too.

    python -m tools.bench --device cuda:0 --worlds 512 --models DIR --lights DIR --json bench.json
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import itertools
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import warp as wp
from rich.console import Console

from synpick_warp.cli.commands import parse_resolution
from synpick_warp.cli.doctor import GIB, describe_machine
from synpick_warp.codes import Status
from synpick_warp.configs.load import COMMAND_LINE, load_config, parse_assignment
from synpick_warp.configs.schema import Config
from synpick_warp.device import pick_device
from synpick_warp.errors import SynpickError
from synpick_warp.exporters.registry import Exporters, load_exporter_classes
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.pipeline import Factory, build_factory, run_bake
from synpick_warp.progress import SilentProgress
from synpick_warp.stages import timing
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import FrameStream, TickReader, TickReport
from tools.bench.physics import BURST, Row, measure_simulation, seconds_per_call
from tools.bench.sensor import measure_sensor
from tools.bench.write import measure_writing

PARTS = ("physics", "sight", "render", "sensor", "write", "bake")
STREAM_BATCHES = 12
"""Batches that are rendered and copied in a row."""
WRITE_VIEWS = 12
"""Views that the writers get over and over."""
BAKE_WORLDS, BAKE_ROUNDS, BAKE_SPEED = 16, 1, 0.4
"""Most worlds of the small bake; rounds and speed [m/s] of its gripper, which moves: short episodes."""
BAKE_METHODS = (
    (Simulation, "tick", "launch ticks"),
    (TickReader, "wait", "wait for ticks"),
    (FrameStream, "_launch", "launch views"),
    (FrameStream, "_collect", "wait for views"),
    (Exporters, "write_views", "hand views to writers"),
    (WriterPool, "wait", "wait for writers, finish files"),
)
"""Where the main process of a bake spends its time; on the CPU, launching is computing."""


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and return the exit code. What was measured before an interruption is kept."""
    options = _parse(arguments)
    console = Console(highlight=False)
    rows: list[Row] = []
    machine: dict[str, str] = {}
    code = 0
    try:
        config = _config(options)
        device = pick_device(config.bake.device)
        config = with_enough_worlds(config, device)
        width, height = config.cameras.resolution
        measured = f"{config.bake.worlds} worlds, {len(config.cameras.positions)} cameras, {width}x{height}"
        machine = dict([*describe_machine(device), ("measured", measured)])
        for name, value in machine.items():
            console.print(f"{name:20} {value}")
        for row in measure(config, options.parts, options.seconds):
            rows.append(row)
            console.print(f"{row.part:8} {row.name:52} {row.value:14,.3f} {row.unit}")
    except SynpickError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        code = 130
    if options.json and rows:
        record = {"machine": machine, "real_objects": bool(options.models), "rows": [dataclasses.asdict(row) for row in rows]}
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    return code


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--device", default="auto", help="cpu, cuda:N or auto (default)")
    parser.add_argument("--worlds", type=int, default=512, help="totes side by side (default 512)")
    parser.add_argument("--resolution", default="1920x1080", help="WIDTHxHEIGHT [px] (default 1920x1080)")
    parser.add_argument("--models", default="", help="folder of BOP models (default: the embedded objects)")
    parser.add_argument("--lights", default="", help="folder of light maps (default: the embedded skies)")
    parser.add_argument("--parts", type=_parts, default=PARTS, help=f"what to measure, with commas (default {','.join(PARTS)})")
    parser.add_argument("--seconds", type=float, default=2.0, help="least time a measurement is repeated [s] (default 2)")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="any other setting; may be repeated")
    parser.add_argument("--json", type=Path, help="write the numbers to this file, too")
    return parser.parse_args(arguments)


def _parts(text: str) -> tuple[str, ...]:
    parts = tuple(text.split(","))
    if unknown := [part for part in parts if part not in PARTS]:
        raise argparse.ArgumentTypeError(f"no such part: {', '.join(unknown)}; parts: {', '.join(PARTS)}")
    return parts


def _config(options: argparse.Namespace) -> Config:
    overrides: dict[str, object] = dict(parse_assignment(text) for text in options.set)
    overrides |= {
        "bake.device": options.device,
        "bake.worlds": options.worlds,
        "bake.episodes": options.worlds,
        "bake.models": options.models,
        "bake.lights": options.lights,
        "cameras.resolution": parse_resolution(options.resolution),
    }
    return load_config(None, overrides, source=COMMAND_LINE)


def measure(config: Config, parts: tuple[str, ...], least: float) -> Iterator[Row]:
    """All numbers of the parts, as they come. `least` is the time a measurement is repeated [s]."""
    if set(parts) - {"bake"}:
        started = time.perf_counter()
        records = "write" in parts and any(kind.needs_physics for kind in load_exporter_classes(config.bake.formats))
        factory = build_factory(config, SilentProgress(), records_physics=records)
        wp.synchronize_device(factory.simulation.device)
        yield Row("setup", "load and build", time.perf_counter() - started, "s")
        values: dict[str, float] = {}
        for row in _worlds(config, factory, least, parts):
            values[row.name] = row.value
            yield row
        yield from _share_of_a_bake(config, values)
        if "write" in parts:
            worlds = min(factory.simulation.layout.worlds, -(-WRITE_VIEWS // len(factory.cameras)))
            yield from measure_writing(config, factory, _all_live(factory.simulation, worlds), least)
        yield _memory(factory.simulation.device)
    if "bake" in parts:
        yield from _bake(config)


def _worlds(config: Config, factory: Factory, least: float, parts: tuple[str, ...]) -> Iterator[Row]:
    """Simulated, and seen."""
    yield from measure_simulation(factory, least, parts)
    if "render" in parts:
        yield from _render(config, factory, least)
    if "sensor" in parts:
        yield from measure_sensor(config, factory, least)


def _share_of_a_bake(config: Config, values: dict[str, float]) -> Iterator[Row]:
    """What looks and plans take of a tick in which every world picks and is rendered, if all that was measured."""
    looks, step, rate = (
        values.get(name) for name in ("perception and planning, a tick", "picking: a step of all worlds", "views, all stages")
    )
    if looks is not None and step and rate:
        views = 1e3 * config.bake.worlds * len(config.cameras.positions) / rate
        share = looks / (step * config.physics.steps_per_tick + views)
        yield Row("sight", "looks and plans: share of the time with rendering", 100.0 * share, "%")


def _memory(device: wp.Device) -> Row:
    if device.is_cuda:
        return Row("setup", "device memory in use, by anybody", (device.total_memory - device.free_memory) / GIB, "GiB")
    return Row("setup", "memory of the process, most", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2, "GiB")


def _all_live(simulation: Simulation, worlds: int) -> TickReport:
    """The report of the last tick, as if it were a frame of the first `worlds` worlds and of no other."""
    reader = TickReader(simulation.records[0])
    reader.start()
    report = reader.wait()
    report.status[:, Status.LIVE] = np.arange(simulation.layout.worlds) < worlds
    return report


def _render(config: Config, factory: Factory, least: float) -> Iterator[Row]:
    """Time of each stage of a view, of a batch in one go, and of batches with copies beside them."""
    simulation, stream = factory.simulation, factory.stream
    device, cameras = simulation.device, len(factory.cameras)
    count = min(stream.batch, simulation.layout.worlds * cameras)
    yield Row("render", "views in a batch", count, "")
    views, out, renderer = _first_views(factory, count), stream.buffers[0], stream.renderer

    def render() -> None:
        renderer.render(simulation.records[0].snapshot, views, out)

    spent = {name: seconds / count for name, seconds in _time_passes(render, device, least).items()}
    spent["all"] = seconds_per_call(render, device, least / 4, BURST) / count
    for name, seconds in spent.items():
        yield Row("render", f"a view: {name}", 1e3 * seconds, "ms")
    yield Row("render", "views, ground truth alone", 1.0 / (spent["set up views"] + spent["rasterize"] + spent["annotate"]), "1/s")
    yield Row("render", "views, all stages", 1.0 / spent["all"], "1/s")
    if device.is_cuda:
        size = sum(array.capacity for array in stream.copies[0].source)

        def copy() -> None:
            stream.copies[0].start(stream.copy_stream)
            stream.copies[0].wait()

        seconds = seconds_per_call(copy, device, least / 4)
        yield Row("render", "copy to the host", 1e-9 * size / seconds, "GB/s")
        yield Row("render", "views copied to the host", stream.batch / seconds, "1/s")
    worlds = min(simulation.layout.worlds, -(-STREAM_BATCHES * stream.batch // cameras))
    report = _all_live(simulation, worlds)
    seconds = seconds_per_call(lambda: [len(batch) for batch in stream.render(simulation.records[0].snapshot, report)], device, least)
    yield Row("render", "views, all stages and copies", worlds * cameras / seconds, "1/s")


def _first_views(factory: Factory, count: int) -> Any:
    """The struct `Views` of the first `count` views: world by world and camera by camera."""
    cameras, renderer, view = len(factory.cameras), factory.stream.renderer, np.arange(count, dtype=np.int32)
    world, camera = (wp.array(values, dtype=wp.int32, device=renderer.scene.device) for values in (view // cameras, view % cameras))
    return make_views(world, camera, count, renderer.instances)


def _time_passes(render: Callable[[], None], device: wp.Device, least: float) -> dict[str, float]:
    """Mean time [s] of each timing scope of `render`, by name, the scopes around it first."""
    render()
    wp.synchronize_device(device)
    with timing.record() as recorder:
        started = time.perf_counter()
        while time.perf_counter() - started < least:
            for _ in range(BURST):
                render()
            wp.synchronize_device(device)
    times = recorder.times.items()
    return {": ".join(path): (stage.device if device.is_cuda else stage.host) / stage.calls for path, stage in times}


class _StageTimes(SilentProgress):
    """Notes when each stage of a bake begins."""

    def __init__(self) -> None:
        self.begun: list[tuple[str, float]] = []

    def stage(self, text: str) -> None:
        self.begun.append((text, time.perf_counter()))


def _bake(config: Config) -> Iterator[Row]:
    """A small bake: seconds by stage, and where the main process spends them."""
    worlds = min(config.bake.worlds, BAKE_WORLDS)
    small = dataclasses.replace(
        config,
        bake=dataclasses.replace(config.bake, mode="move", worlds=worlds, episodes=worlds),
        move=dataclasses.replace(config.move, rounds=BAKE_ROUNDS, speed=BAKE_SPEED),
    )
    progress, spent = _StageTimes(), dict.fromkeys((name for _, _, name in BAKE_METHODS), 0.0)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as patches:
        for kind, method, name in BAKE_METHODS:
            patches.enter_context(mock.patch.object(kind, method, _timed(getattr(kind, method), spent, name)))
        summary = run_bake(small, Path(folder) / "out", progress)
        progress.stage("")
    yield Row("bake", "worlds, and episodes", worlds, "")
    yield Row("bake", "views", summary.views, "")
    yield Row("bake", "views", summary.views / summary.wall_seconds, "1/s")
    for (text, begun), (_, ended) in itertools.pairwise(progress.begun):
        yield Row("bake", f"stage: {text}", ended - begun, "s")
    for name, seconds in spent.items():
        yield Row("bake", f"main process: {name}", seconds, "s")


def _timed(function: Callable[..., object], spent: dict[str, float], name: str) -> Callable[..., object]:
    """The function, whose time is added to `spent[name]`."""

    @functools.wraps(function)
    def wrapper(*arguments: object, **options: object) -> object:
        started = time.perf_counter()
        result = function(*arguments, **options)
        spent[name] += time.perf_counter() - started
        return result

    return wrapper


if __name__ == "__main__":
    sys.exit(main())
