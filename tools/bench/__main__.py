"""Benchmark of a bake's parts: physics, perception, rendering, encoders, writing, the online stream, and of whole bakes.

Measurements follow a warm-up and are medians of synchronised repetitions. Physics, perception and rendering use the same worlds, in
mode pick; with `--set bake.mode=move`, piles are stirred instead. Writers get the same views repeatedly. Files are written to the
system's temporary folder (TMPDIR) and removed. The part render renders one tick repeatedly; the part pictures renders successive ticks,
with light histories as in a bake. --compare measures other simulators and renderers beside ours, without any part
unless --parts names some.

    python -m tools.bench --device cuda:0 --worlds 512 --models DIR --lights DIR --json bench.json
    python -m tools.bench --compare mujoco-warp,mujoco,sensor-camera --models DIR --lights DIR
"""

from __future__ import annotations

import argparse
import functools
import itertools
import resource
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp
from rich.console import Console

from synpick_warp.cli.commands.doctor import GIB, describe_machine
from synpick_warp.cli.main import parse_resolution
from synpick_warp.codes import Status
from synpick_warp.configs.schema import Cameras, Config
from synpick_warp.environment.make import make_picking
from synpick_warp.errors import SynpickError
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.assembly import Factory, build_factory, build_stages
from synpick_warp.stages import timing
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReport, read_tick
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.bench.compare.peers import PEERS, check_installed, measure_peers
from tools.bench.encode import measure_encoding
from tools.bench.environment import measure_environment
from tools.bench.growth import measure_growth
from tools.bench.heaps import measure_heaps, measure_perception
from tools.bench.patches import measure_patches
from tools.bench.physics import BURST, measure_simulation, seconds_per_call
from tools.bench.picks import measure_picks
from tools.bench.pictures import measure_pictures
from tools.bench.steady import measure_steady
from tools.bench.stream import measure_stream
from tools.bench.trajectories import measure_trajectories
from tools.bench.whole import WholeBake, measure_whole
from tools.bench.write import measure_writing
from tools.figures import describe_run, write_run
from tools.options import (
    INTERRUPTED,
    Row,
    configure,
    fail,
    finite_seconds,
    make_names_parser,
    make_parser,
    of_part,
    positive_count,
)

DEFAULT_PARTS = ("physics", "perception", "render", "encode", "write", "stream", "steady")
PARTS = (*DEFAULT_PARTS, "pictures", "whole", "trajectories", "growth", "patches", "heaps", "environment", "picks")
OWN_WORLDS = {*PARTS[len(DEFAULT_PARTS) :], "steady"}
"""Parts that build worlds of their own."""
WORLDS = 512
"""Default number of worlds of all parts but `whole`."""
STREAM_BATCHES = 12
"""Number of batches that are rendered and copied back to back."""
WRITE_VIEWS = 12
"""Number of views that are written over and over."""
WHOLE_EPISODES = 150
"""Default number of episodes of the part `whole`."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code. Rows measured before an interruption are written."""
    options = _parse(arguments)
    console = Console(highlight=False)
    rows: list[Row] = []
    machine: dict[str, str] = {}
    traces: dict[str, Any] = {}
    code = 0
    try:
        check_installed(options.compare)
        config = _config(options)
        device = pick_device(config.bake.device)
        config = with_enough_worlds(config, device)
        machine = dict([*describe_machine(device), ("measured", _describe_setup(config.bake.worlds, config.cameras, options))])
        for name, value in machine.items():
            console.print(f"{name:20} {value}")
        measured_peers = measure_peers(config, options.compare, options.seconds)
        bake = WholeBake(options.episodes, options.worlds or 0)
        parts = measure(config, options.parts, options.seconds, traces, bake, options.devices, options.after, options.instances)
        for row in itertools.chain(parts, measured_peers):
            rows.append(row)
            console.print(f"{row.part:11} {row.name:52} {row.value:14,.3f} {row.unit}", soft_wrap=True)
    except SynpickError as error:
        return fail("bench", error)
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        code = INTERRUPTED
    if rows:
        write_run(options.json, describe_run("tools.bench", machine.items(), rows, **traces))
    return code


def _describe_setup(count: int, cameras: Cameras, options: argparse.Namespace) -> str:
    """Worlds, cameras and resolution. If `whole` is the only part: also its episodes, and the worlds may be automatic."""
    worlds = f"{count} worlds"
    if set(options.parts) == {"whole"} and not options.compare:
        worlds = f"{options.episodes} episodes, " + (worlds if options.worlds else "automatic worlds")
    width, height = cameras.resolution
    return f"{worlds}, {len(cameras.positions)} cameras, {width}x{height}"


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "config", "device", "models", "lights", "set", "json")
    worlds_help = f"worlds simulated in parallel (default: {WORLDS}; the part whole: as many as a bake of --episodes chooses)"
    parser.add_argument("--worlds", type=positive_count, help=worlds_help)
    parser.add_argument("--resolution", default="1920x1080", help="WIDTHxHEIGHT [px] (default: 1920x1080)")
    more = ",".join(PARTS[len(DEFAULT_PARTS) :])
    parts_help = f"parts to measure, comma-separated (default: {','.join(DEFAULT_PARTS)}; and {more})"
    parser.add_argument("--parts", type=make_names_parser(PARTS, "part"), help=parts_help)
    peers_help = f"peers to measure beside ours, comma-separated, of {', '.join(PEERS)}; then no parts unless --parts names some"
    parser.add_argument("--compare", type=make_names_parser(PEERS, "peer"), default=(), metavar="PEERS", help=peers_help)
    after_help = "ticks simulated before the part pictures, in which little moves just after the drop (default: 0)"
    parser.add_argument("--after", type=positive_count, default=0, metavar="TICKS", help=after_help)
    parser.add_argument("--episodes", type=positive_count, help=f"episodes of the part whole (default: {WHOLE_EPISODES})")
    devices_help = "several devices of the part steady, as of bake: cuda:0,cuda:1 or all; --worlds is the number of each"
    parser.add_argument("--devices", default="", help=devices_help)
    instances_help = "numbers of like parts, of which the part growth measures physics alone: 10,32,64,128,251"
    parser.add_argument("--instances", type=_parse_numbers, default=(), metavar="NUMBERS", help=instances_help)
    parser.add_argument("--seconds", type=finite_seconds, default=2.0, help="minimum time of a measurement [s] (default: 2)")
    options = parser.parse_args(arguments)
    if options.parts is None:
        options.parts = () if options.compare else DEFAULT_PARTS
    options.devices = tuple(name.strip() for name in options.devices.split(",")) if options.devices else ()
    for name, part, use in (
        ("devices", "steady", "several"),
        ("episodes", "whole", "it"),
        ("after", "pictures", "it"),
        ("instances", "growth", "it"),
    ):
        if getattr(options, name) and part not in options.parts:
            parser.error(f"--{name} needs the part {part}, the only one that uses {use}")
    if options.devices and options.device != parser.get_default("device"):
        parser.error("--device and --devices are both given; name one device by --device, or several by --devices")
    options.episodes = options.episodes or WHOLE_EPISODES
    return options


def _parse_numbers(text: str) -> tuple[int, ...]:
    """Argument type of an option: comma-separated integers above 0."""
    return tuple(positive_count(part) for part in text.split(","))


def _config(options: argparse.Namespace) -> Config:
    worlds, resolution = options.worlds or WORLDS, parse_resolution(options.resolution)
    return configure(options, {"bake.worlds": worlds, "bake.episodes": worlds, "cameras.resolution": resolution})


def measure(
    config: Config,
    parts: tuple[str, ...],
    min_seconds: float,
    traces: dict[str, Any],
    bake: WholeBake,
    devices: tuple[str, ...] = (),
    after: int = 0,
    instances: tuple[int, ...] = (),
) -> Iterator[Row]:
    """Measure the parts; yields rows as they arrive.

    Args:
        config: All settings.
        parts: Parts, in any order.
        min_seconds: Time for which a measurement is repeated, at least [s].
        traces: Receives what changes during a measurement, by part.
        bake: Size of the bake of the part whole.
        devices: Devices of the part steady; empty: that of the settings.
        after: Ticks simulated before the part pictures.
        instances: Numbers of parts that the part growth measures, instead of its factors.
    """
    if set(parts) - OWN_WORLDS:
        started = time.perf_counter()
        needs = Needs.of(config)
        records = "write" in parts and needs.physics
        factory = build_factory(config, SilentProgress(), records_physics=records, needs_images=needs.images)
        wp.synchronize_device(factory.simulation.device)
        yield Row("load and build", time.perf_counter() - started, "s", part="setup")
        values: dict[str, float] = {}
        for row in _measure_worlds(config.bop.jpeg_quality, factory, min_seconds, parts):
            values[row.name] = row.value
            yield row
        yield from _perception_fraction(config.bake.worlds * len(config.rig), config.physics.steps_per_tick, values)
        if "write" in parts:
            worlds = min(factory.simulation.layout.worlds, -(-WRITE_VIEWS // len(factory.cameras)))
            yield from of_part("write", measure_writing(factory, _mark_live(factory.simulation, worlds), min_seconds))
        if "stream" in parts:
            live = _mark_live(factory.simulation, factory.simulation.layout.worlds)
            yield from of_part("stream", measure_stream(factory, live, min_seconds))
        yield _memory_in_use(factory.simulation.device)
    if "pictures" in parts:
        yield from of_part("pictures", measure_pictures(config, after))
    steady_rate = 0.0
    if "steady" in parts:
        for row in of_part("steady", measure_steady(config, min_seconds, devices)):
            steady_rate = row.value if row.name == "views to disk" else steady_rate
            yield row
    if "whole" in parts:
        yield from of_part("whole", measure_whole(config, bake, steady_rate, traces))
    others = {
        "trajectories": measure_trajectories(config, min_seconds),
        "growth": measure_growth(config, min_seconds, instances),
        "patches": measure_patches(config),
        "heaps": measure_heaps(config, min_seconds),
        "environment": measure_environment(functools.partial(make_picking, source=config), config.bake.worlds, min_seconds),
        "picks": measure_picks(functools.partial(build_stages, config.with_values({"bake.mode": "pick"})), config.bake),
    }
    yield from itertools.chain.from_iterable(of_part(part, rows) for part, rows in others.items() if part in parts)


def _measure_worlds(quality: int, factory: Factory, min_seconds: float, parts: tuple[str, ...]) -> Iterator[Row]:
    """Benchmark of simulation and perception, and then of rendering the same worlds."""
    yield from of_part("physics", measure_simulation(factory, min_seconds, parts))
    simulation = factory.simulation
    if simulation.perception is not None and "perception" in parts:
        rows = measure_perception(simulation.perception, simulation.record.snapshot, simulation.device, min_seconds)
        yield from of_part("perception", rows)
    if "render" in parts:
        yield from of_part("render", _measure_rendering(factory, min_seconds))
    if "encode" in parts:
        count = min(factory.stream.rings[0].batch, factory.simulation.layout.worlds * len(factory.cameras))
        images, renderer, device = factory.stream.rings[0].slots[0].images, factory.stream.rings[0].renderer, factory.simulation.device
        views = first_views(count, len(factory.cameras), renderer.instances, device)
        renderer.render(factory.simulation.record.snapshot, views, images)
        yield from of_part("encode", measure_encoding(images, count, quality, device, min_seconds))


def _perception_fraction(views: int, steps: int, values: dict[str, float]) -> Iterator[Row]:
    """Fraction of perception and planning in a tick in which all worlds pick and are rendered, if all of these were measured."""
    perceive, step, rate = (
        values.get(name) for name in ("perception and planning, a tick", "picking: a step of all worlds", "views, all stages")
    )
    if perceive is not None and step and rate:
        render = 1e3 * views / rate
        fraction = perceive / (step * steps + render)
        yield Row("perception and planning: fraction of simulation and rendering", 100.0 * fraction, "%", part="perception")


def _memory_in_use(device: wp.Device) -> Row:
    """Row of the device memory in use by all processes; on the CPU, of the process's peak memory."""
    if device.is_cuda:
        return Row("device memory in use by all processes", (device.total_memory - device.free_memory) / GIB, "GiB", part="setup")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Row("peak memory of the process", peak / 1024**2, "GiB", part="setup")


def _mark_live(simulation: Simulation, worlds: int) -> TickReport:
    """Report of the last tick, marked as a frame of the first `worlds` worlds alone."""
    report = read_tick(simulation.record)
    report.status[:, Status.LIVE] = np.arange(simulation.layout.worlds) < worlds
    return report


def _measure_rendering(factory: Factory, min_seconds: float) -> Iterator[Row]:
    """Benchmark of rendering: each stage of a view, a whole batch, copies to the host, and batches with copies overlapped."""
    simulation, stream = factory.simulation, factory.stream
    device, cameras = simulation.device, len(factory.cameras)
    count = min(stream.rings[0].batch, simulation.layout.worlds * cameras)
    yield Row("views in a batch", count, "")
    out, renderer = stream.rings[0].slots[0].images, stream.rings[0].renderer
    views = first_views(count, cameras, renderer.instances, device)

    def render() -> None:
        renderer.render(simulation.record.snapshot, views, out)

    spent = {name: seconds / count for name, seconds in _time_passes(render, device, min_seconds).items()}
    spent["all"] = seconds_per_call(render, device, min_seconds / 4, BURST) / count
    for name, seconds in spent.items():
        yield Row(f"a view: {name}", 1e3 * seconds, "ms")
    yield Row("views, ground truth alone", 1.0 / (spent["set up views"] + spent["rasterize"] + spent["annotate"]), "1/s")
    yield Row("views, all stages", 1.0 / spent["all"], "1/s")
    if device.is_cuda:
        size = sum(array.capacity for array in stream.rings[0].copies[0].source)

        def copy() -> None:
            stream.rings[0].copies[0].start(stream.streams.copy)
            stream.rings[0].copies[0].wait()

        seconds = seconds_per_call(copy, device, min_seconds / 4)
        yield Row("copy to the host", 1e-9 * size / seconds, "GB/s")
        yield Row("views copied to the host", stream.rings[0].batch / seconds, "1/s")
    worlds = min(simulation.layout.worlds, -(-STREAM_BATCHES * stream.rings[0].batch // cameras))
    report = _mark_live(simulation, worlds)
    seconds = seconds_per_call(lambda: [len(batch) for batch in stream.render(simulation.record.snapshot, report)], device, min_seconds)
    yield Row("views, all stages and copies", worlds * cameras / seconds, "1/s")


def _time_passes(render: Callable[[], None], device: wp.Device, min_seconds: float) -> dict[str, float]:
    """Mean time [s] of each timing scope of `render`, by its path: names of outer scopes and its own, joined by ': '."""
    render()
    wp.synchronize_device(device)
    with timing.record() as recorder:
        started = time.perf_counter()
        while not recorder.times or time.perf_counter() - started < min_seconds:
            for _ in range(BURST):
                render()
            wp.synchronize_device(device)
    times = recorder.times.items()
    return {": ".join(path): (stage.device if device.is_cuda else stage.host) / stage.calls for path, stage in times}


if __name__ == "__main__":
    sys.exit(main())
